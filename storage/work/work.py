"""The work folder: one folder a stage, named by the hash of all that its output depends on.

    work/<stage>-<hash>/   the stage's arrays
        results/<i>.json   one a finished task, so that a restart does only what is missing
        parts/             what tasks leave for finalise alone; goes once the stage is complete, so finalise may run
        again summary.json       written last: the stage is complete; and the seconds that it took

Folders and files are few: where workers write gigabytes, a new one takes a disk's journal milliseconds.

A worker that was given up may still run its task while another repeats it. Both make the same bytes, so whatever has a
name of its own is written aside (`*.partial*`) and given its name whole, or not at all where it is there already.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec
import numpy as np

from storage import place
from storage.whole import whole

LAYOUT_VERSION = 19  # raised when a stage's output changes for equal inputs

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class TaskRecord(Generic[T]):
    """A task that has finished: what it returned, and what it took. `compile_seconds`, part of the seconds, went into
    kernels that a process compiles or loads once."""

    result: T
    n_splats: int  # of the result; 0 where it is of none
    seconds: float
    processor_seconds: float
    compile_seconds: float
    peak_rss_bytes: int


class _Kept(msgspec.Struct, Generic[T]):
    """What stands in summary.json."""

    seconds: float
    summary: T


def write_json(path: Path, data: Any) -> None:
    """Strict JSON, dataclasses as objects, under its name only when it is whole."""
    with whole(path) as partial:
        partial.write_text(json.dumps(data, allow_nan=False, default=dataclasses.asdict))


def read_json(path: Path) -> Any:
    """What a JSON file of a work folder holds."""
    return json.loads(place.here(path).read_text())


def write_parts(path: Path, **arrays: np.ndarray) -> None:
    """Arrays as one .npz, under its name only when it is whole."""
    place.make_folder(path.parent)
    with whole(path) as partial, open(partial, "wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]


def write_part(path: Path, array: np.ndarray) -> None:
    """One array as .npy, which can be mapped, under its name only when it is whole."""
    place.make_folder(path.parent)
    with whole(path) as partial, open(partial, "wb") as stream:
        np.save(stream, array)


def open_parts(path: Path) -> Any:
    """What `write_parts` wrote, to be closed."""
    return np.load(place.here(path))


def map_part(path: Path) -> np.ndarray:
    """What `write_part` wrote, read where it is looked at."""
    return np.load(place.here(path), mmap_mode="r")


def stage_folder(work: Path, stage: Any) -> Path:
    """Where a stage's output lies. `stage` is a frozen dataclass; a path among its fields counts by its name, which
    for another stage's folder holds that stage's hash in turn."""
    fields = {f.name: getattr(stage, f.name) for f in dataclasses.fields(stage)}
    plain = {
        name: value.name if isinstance(value, Path) else value
        for name, value in fields.items()
        if name not in getattr(stage, "location_fields", ())
    }
    text = json.dumps([LAYOUT_VERSION, stage.name, plain], sort_keys=True, default=_plain)
    return work / f"{stage.name}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"


def _plain(value: Any) -> Any:
    """A field of a field: a folder counts by its name, as above."""
    return value.name if isinstance(value, Path) else dataclasses.asdict(value)


def is_complete(folder: Path) -> bool:
    """Whether a stage is done: its summary is written last."""
    return place.is_file(folder / "summary.json")


def last_complete(work: Path, name: str) -> Path | None:
    """The folder of the stage of this name that was completed last; None if none ever was."""
    folders = (work / found for found in place.names(work) if found.startswith(f"{name}-"))
    ages = {folder: place.age_s(folder / "summary.json") for folder in folders}
    return min((f for f, age in ages.items() if age is not None), key=ages.__getitem__, default=None)


def begin(folder: Path) -> None:
    """Make a stage's folder, where it is not there."""
    place.make_folder(folder / "results")


def parts(folder: Path) -> Path:
    """The folder for what tasks leave for `finalise` alone."""
    return folder / "parts"


def sweep(folder: Path) -> None:
    """Delete what tasks that are gone had half written. Whole arrays, results and parts stay. A bucket has no
    halves."""
    if place.is_remote(folder):
        return
    for path in [*folder.rglob("*.partial*")]:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def finished_tasks(folder: Path, kind: Any = Any) -> dict[int, TaskRecord]:
    """The tasks that have finished, by index; their results as `kind`.

    Raises: msgspec.ValidationError, a mistake of ours, where a result lacks a field of `kind`.
    """
    done = [folder / "results" / name for name in place.names(folder / "results") if name.endswith(".json")]
    decoder = _decoder(TaskRecord[kind])
    return {int(p.stem): decoder.decode(file.read_bytes()) for p, file in zip(done, place.all_here(done))}


def finished_task(folder: Path, index: int, kind: Any = Any) -> TaskRecord | None:
    """One task, if it has finished."""
    path = _result_path(folder, index)
    return _decoder(TaskRecord[kind]).decode(place.here(path).read_bytes()) if place.is_file(path) else None


def record_task(folder: Path, index: int, record: TaskRecord) -> None:
    """Keep the record of a task: it is not run again."""
    write_json(_result_path(folder, index), record)


def _result_path(folder: Path, index: int) -> Path:
    return folder / "results" / f"{index:06d}.json"


def complete(folder: Path, summary: Any, seconds: float) -> None:
    """Note that a stage is done: its summary, a dataclass or what JSON has, and how long it took."""
    write_json(folder / "summary.json", {"seconds": seconds, "summary": summary})
    place.remove_folder(parts(folder))


def summary(folder: Path, kind: type[T]) -> T:
    """The summary of a stage that is done, as `kind`: a dataclass that its JSON has all the fields of.

    Raises: msgspec.ValidationError, a mistake of ours, where it has not.
    """
    return _decoder(_Kept[kind]).decode(place.here(folder / "summary.json").read_bytes()).summary  # type: ignore[valid-type]


@functools.cache
def _decoder(kind: Any) -> msgspec.json.Decoder:
    return msgspec.json.Decoder(kind)


def made_seconds(folder: Path) -> float:
    """What a stage took when it was made; of one that was cut off and gone on with, its last part alone."""
    return read_json(folder / "summary.json")["seconds"]


def discard(folder: Path) -> None:
    """Remove a stage's folder with all in it."""
    place.remove_folder(folder)
