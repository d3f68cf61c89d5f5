"""Files and folders of a place, wherever it is: what `pathlib` and `shutil` do for a folder of this machine."""

from __future__ import annotations

import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from storage.place import objects
from storage.place.cache import cache
from storage.place.objects import is_remote

AT_ONCE = 8  # requests side by side
_put: dict[Path, tuple[int, int, int]] = {}  # by object, the file that `put_folder` put there


def here(path: Path) -> Path:
    """A file of this machine with the bytes of `path`, to be opened now and not written to. Raises
    FileNotFoundError."""
    return cache().fetched(path) if is_remote(path) else path


def held(path: Path) -> Path:
    """As `here`, of a file that is opened again and again: it stays in the cache until two others were held since."""
    return cache().fetched(path, hold=True) if is_remote(path) else path


def all_here(paths: Iterable[Path]) -> list[Path]:
    """As `here`, side by side; they have to fit into the cache together."""
    paths = list(paths)
    if not paths or not is_remote(paths[0]):
        return paths
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return list(pool.map(here, paths))


@contextmanager
def written(path: Path, suffix: str) -> Iterator[Path]:
    """A file of this machine to write to, which becomes the object `path` at the end, whole; kept in the cache too."""
    kept = cache()
    target = kept.place(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f"{target.name}.{uuid.uuid4().hex}{suffix}")
    try:
        yield partial
        objects.put(path, partial)
        kept.take_in(partial, target, partial.stat().st_size)
    finally:
        partial.unlink(missing_ok=True)


def put_in_place(file: Path, path: Path) -> None:
    """Move a file of this machine to a place, durably."""
    if is_remote(path):
        objects.put(path, file)
        file.unlink()
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(file, "rb") as stream:
        os.fsync(stream.fileno())
    os.replace(file, path)


def put_folder(folder: Path, path: Path) -> None:
    """The files of a folder of this machine, as objects below `path`, but for those that this process put there before
    as they are; nothing where the two are one folder."""
    if not is_remote(path):
        return
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and ".partial" not in p.name]

    def put(file: Path) -> None:
        target, stat = path / file.relative_to(folder), file.stat()
        state = (stat.st_ino, stat.st_size, stat.st_mtime_ns)
        if _put.get(target) != state:
            objects.put(target, file)
            cache().forget(target)
            _put[target] = state

    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(put, files))


def is_file(path: Path) -> bool:
    """Whether a file, or an object of a bucket, is there."""
    return objects.head(path) is not None if is_remote(path) else path.is_file()


def sizes(folder: Path) -> dict[str, int]:
    """Bytes of all files below a folder by their names within it, in order."""
    if is_remote(folder):
        return objects.listed(folder)
    files = (p for p in sorted(folder.rglob("*")) if p.is_file())
    return {p.relative_to(folder).as_posix(): p.stat().st_size for p in files}


def names(folder: Path) -> list[str]:
    """Of the files and folders right in a folder, in order."""
    if is_remote(folder):
        return list(dict.fromkeys(name.partition("/")[0] for name in objects.listed(folder)))
    return sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []


def make_folder(folder: Path) -> None:
    """Buckets have none."""
    if not is_remote(folder):
        folder.mkdir(parents=True, exist_ok=True)


def made_once(path: Path, make: Callable[[], bytes]) -> bytes:
    """The content of a file that nobody but its owner may read; what `make` gives where there is none yet. Of many that
    ask at once all get the same."""
    if is_remote(path):
        try:
            return objects.get(path)[0]
        except FileNotFoundError:
            try:
                objects.put(path, make(), over=None)
            except objects.Taken:
                pass
            return objects.get(path)[0]
    if not path.is_file():
        partial = path.with_name(f"{path.name}.{uuid.uuid4().hex}.partial")
        with open(os.open(partial, os.O_WRONLY | os.O_CREAT, 0o600), "wb") as stream:
            stream.write(make())
        try:
            os.link(partial, path)  # unlike a rename this never replaces another's
        except FileExistsError:
            pass
        partial.unlink()
    return path.read_bytes()


def bring_folder(path: Path, folder: Path) -> None:
    """The other way of `put_folder`: what `folder` lacks, or has in another size."""
    if not is_remote(path):
        return
    for name, size in objects.listed(path).items():
        target = folder / name
        if not target.is_file() or target.stat().st_size != size:
            bring_file(path / name, target)


def bring_file(path: Path, target: Path) -> None:
    """A copy for this machine, there whole."""
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f"{target.name}.{uuid.uuid4().hex}.partial")
    shutil.copyfile(here(path), partial)
    os.replace(partial, target)


def scratch(folder: Path) -> Path:
    """A folder of this machine for what one task writes and throws away."""
    made = cache().place(folder) if is_remote(folder) else folder
    made.mkdir(parents=True, exist_ok=True)
    return made


def remove(path: Path) -> None:
    """Remove a file, or an object of a bucket; one that is not there is none to remove."""
    if is_remote(path):
        objects.remove([path])
        cache().forget(path)
    else:
        path.unlink(missing_ok=True)


def remove_folder(folder: Path) -> None:
    """With all in it; where there is none, nothing."""
    if is_remote(folder):
        for gone in [target for target in _put if folder in target.parents]:
            del _put[gone]
        objects.remove([folder / name for name in objects.listed(folder)])
        cache().forget(folder)
    else:
        shutil.rmtree(folder, ignore_errors=True)


def read_text(path: Path) -> str:
    """As it is now, of a file that may change. Raises FileNotFoundError."""
    return objects.get(path)[0].decode() if is_remote(path) else path.read_text()


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8, in a bucket as one object."""
    if is_remote(path):
        objects.put(path, text.encode())
    else:
        path.write_text(text)


def touch(path: Path) -> None:
    """Let an empty file, or object, be there; its folder is made."""
    if is_remote(path):
        objects.put(path, b"")
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def age_s(path: Path) -> float | None:
    """Seconds since a file was written; None where there is none. Of a bucket by the server's clock against ours."""
    if is_remote(path):
        found = objects.head(path)
        return None if found is None else max(0.0, time.time() - found.changed)
    try:
        return max(0.0, time.time() - path.stat().st_mtime)
    except (FileNotFoundError, NotADirectoryError):
        return None


def zarr_store(folder: Path):
    """What zarr opens a folder by."""
    if not is_remote(folder):
        return str(folder)
    from storage.place.for_zarr import zarr_store  # zarr takes a while to import, which a client does without

    return zarr_store(folder)
