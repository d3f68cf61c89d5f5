"""What the stages of a job read and write, in bytes a splat, as their tasks ask the arrays of the work folder for it.

    python -m benchmarks.bytes_moved SCAN [--preset draft] [--keep] [--json]

A job in this process without pictures; with --keep as with a kept work folder, patches stored. A window of a photograph
counts as the pixels in it, a row as its bytes, as often as it is asked for, whatever the disk cache has of them;
pictures of nearest points as they are unpacked.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.patches import Silent
from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import PRESETS, settings_for
from services.processes.compress import compress
from storage.work import arrays, tiles

Moved = dict[str, dict[str, float]]  # by stage: read and written, in bytes a splat


class Listening(Silent):
    """Which stage is under way."""

    stage = "before"

    def begin(self, name: str, n_tasks: int) -> None:
        self.stage = name


def counted(progress: Listening) -> tuple[Counter, Counter]:
    """Bytes read and written, by stage, of all that is asked of arrays from now on."""
    read, written = Counter(), Counter()

    def listen(module: Any, name: str, count: Callable[..., int], into: Counter) -> None:
        asked = getattr(module, name)

        def listening(*arguments: Any) -> Any:
            result = asked(*arguments)
            into[progress.stage] += count(result, *arguments)
            return result

        setattr(module, name, listening)

    for name in ("read", "read_window", "read_rows", "mapped"):
        listen(arrays, name, lambda result, *_: result.nbytes, read)
    listen(tiles, "read_tiles", lambda result, *_: result.nbytes, read)
    pieces = arrays.pieces

    def pieces_listening(*arguments: Any) -> Any:
        for at, rows in pieces(*arguments):
            read[progress.stage] += rows.nbytes
            yield at, rows

    arrays.pieces = pieces_listening  # type: ignore[assignment]
    listen(arrays, "_write_chunk", lambda result, path, rows, layout: rows.nbytes, written)
    listen(tiles, "store_tiles", lambda _, folder, name, picture: (folder / f"{name}.tiles").stat().st_size, written)
    return read, written


def measure(scan: Path, preset: str, keep: bool) -> tuple[int, Moved]:
    progress = Listening()
    read, written = counted(progress)
    with tempfile.TemporaryDirectory(dir=".") as folder:
        work = Path(folder) / "work" if keep else None
        report = compress(
            scan, Path(folder) / "out", settings_for(preset), SerialExecutor(), progress, render=False, work=work
        )
    n = report["splats"]
    return n, {
        name: {"read": read[name] / n, "written": written[name] / n} for name in [*dict.fromkeys([*read, *written])]
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--preset", choices=list(PRESETS), default="draft")
    parser.add_argument("--keep", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    n, moved = measure(options.scan, options.preset, options.keep)
    if options.json:
        print(json.dumps({"splats": n, "stages": moved}))
        return
    print(f"{n:,} splats, bytes a splat\n{'stage':<20}{'read':>10}{'written':>10}")
    for name, of in moved.items():
        print(f"{name:<20}{of['read']:>10.1f}{of['written']:>10.1f}")
    print(
        f"{'in all':<20}{sum(m['read'] for m in moved.values()):>10.1f}{sum(m['written'] for m in moved.values()):>10.1f}"
    )


if __name__ == "__main__":
    main()
