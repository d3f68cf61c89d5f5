"""The packed file of a large scan, put together by all workers: each writes a range of it."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from storage import place
from storage.packed.seal import SEAL_BYTES
from storage.packed.writing.joined import begin_file, end_file, seal_packed, write_range
from storage.whole import whole
from storage.work import arrays

LARGE = 1 << 32  # bytes of a file that all workers put together; of a smaller one a process takes 4 s
RANGE = 1 << 26  # bytes a task
FILE = "file"


@dataclass(frozen=True)
class Written:
    """What a task tells."""

    n_bytes: int


@dataclass(frozen=True)
class Sealed:
    """Of the whole file."""

    n_bytes: int
    digest: str


@dataclass(frozen=True)
class Join:
    """A task RANGE bytes of the file. Output: the file FILE, which `hand_over` moves to where it is wanted."""

    pack: Path
    name = "join"

    def init(self, folder: Path) -> int:
        return arrays.n_blocks(begin_file(self.pack / "packed", folder / FILE), RANGE)

    def run(self, folder: Path, index: int) -> Written:
        n_bytes = (folder / FILE).stat().st_size - SEAL_BYTES
        start, stop = arrays.block_range(index, n_bytes, RANGE)
        write_range(self.pack / "packed", folder / FILE, start, stop)
        return Written(stop - start)

    def finalise(self, folder: Path, results: list[Written]) -> Sealed:
        """The digest is of all bytes before it, one after the other: one process reads them."""
        return Sealed(sum(r.n_bytes for r in results), end_file(folder / FILE))


def is_joined_by_all(pack: Path, n_bytes: int) -> bool:
    """Whether so large a file, whose groups lie in that folder, is put together by tasks. A bucket has no files that
    several write to."""
    return n_bytes > LARGE and not place.is_remote(pack)


def hand_over(pack: Path, joined: Path, path: Path) -> None:
    """Move the file that `Join` made to `path`. Where it was moved before, perhaps by a process that died then, it is
    there, or is put together once more."""
    if (made := joined / FILE).is_file():
        try:
            os.rename(made, path)
        except OSError:  # another disk
            with whole(path) as partial:
                shutil.copyfile(made, partial)
            made.unlink()
    elif not path.is_file():
        seal_packed(pack / "packed", path)
