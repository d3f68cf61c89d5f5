"""Files of a bucket, kept by one process on its own disk: no more bytes than it may have, the longest unused go first.

A file that goes while it is mapped or open stays readable until it is closed, as the kernel has it.
"""

from __future__ import annotations

import atexit
import errno
import os
import shutil
import tempfile
import threading
import uuid
from collections import OrderedDict
from pathlib import Path

from storage.file_lock import hold, try_to_hold
from storage.place import objects

FOLDER, BYTES = "SPLATPRESS_CACHE", "SPLATPRESS_CACHE_BYTES"
DEFAULT_BYTES = 20 << 30
MOST_HELD = 2
_ALIVE = "alive"


class Cache:
    """Below `folder`, a file has the place of its object: bucket, then key."""

    def __init__(self, folder: Path, bound: int) -> None:
        self.folder, self.bound = folder, bound
        self._kept: OrderedDict[Path, int] = OrderedDict()  # bytes, the longest unused first
        self._held: list[Path] = []  # do not go
        self._used = 0
        self._lock = threading.RLock()

    def place(self, path: Path) -> Path:
        """Where the file of an object lies, whether it is there or not."""
        return self.folder.joinpath(*path.parts[1:])

    def fetched(self, path: Path, hold: bool = False) -> Path:
        """The file of an object. Raises FileNotFoundError, or OSError where it is larger than the cache."""
        target = self.place(path)
        with self._lock:
            if hold:
                self._held = [p for p in self._held if p != target][-(MOST_HELD - 1) :] + [target]
            if target in self._kept:
                self._kept.move_to_end(target)
                return target
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(f"{target.name}.{uuid.uuid4().hex}.partial")
        try:
            size = objects.download(path, partial, self.make_room)
            self.take_in(partial, target, size)
        finally:
            partial.unlink(missing_ok=True)
        return target

    def make_room(self, size: int) -> None:
        """Let files go until so many bytes have room. Raises OSError where they never have."""
        if size > self.bound:
            found = f"a file of {size:,} bytes; allowed: at most {self.bound:,}, the bound of the cache ({BYTES})"
            raise OSError(errno.EFBIG, found)
        with self._lock:
            for oldest in list(self._kept):
                if self._used + size <= self.bound:
                    break
                if oldest not in self._held:
                    self._used -= self._kept.pop(oldest)
                    oldest.unlink(missing_ok=True)
            if self._used + size > self.bound:
                found = (
                    f"{size:,} bytes beside {self._used:,} of scans that are read; allowed: {self.bound:,} ({BYTES})"
                )
                raise OSError(errno.EFBIG, found)

    def take_in(self, partial: Path, target: Path, size: int) -> None:
        """Keep a file that was fetched or written under its name."""
        with self._lock:
            self._used -= self._kept.pop(target, 0)
            self.make_room(size)
            os.replace(partial, target)
            self._kept[target] = size
            self._used += size

    def forget(self, path: Path) -> None:
        """An object or a folder of objects that is no longer there, or another."""
        gone = self.place(path)
        with self._lock:
            for target in [t for t in self._kept if t == gone or gone in t.parents]:
                self._used -= self._kept.pop(target)
                target.unlink(missing_ok=True)

    @property
    def used_bytes(self) -> int:
        return self._used


_of_process: tuple[int, Cache] | None = None
_making = threading.Lock()


def cache() -> Cache:
    """This process's own: a folder below SPLATPRESS_CACHE (default: the system's for temporary files) that goes with
    the process, or, where it was killed, when the next one begins."""
    global _of_process
    with _making:
        if _of_process is None or _of_process[0] != os.getpid():
            _of_process = os.getpid(), _begun()
        return _of_process[1]


def _begun() -> Cache:
    root = Path(os.environ.get(FOLDER) or Path(tempfile.gettempdir()) / f"splatpress-cache-{os.getuid()}")
    root.mkdir(mode=0o700, parents=True, exist_ok=True)
    _clear_the_dead(root)
    folder = root / uuid.uuid4().hex
    folder.mkdir(mode=0o700)
    alive = open(folder / _ALIVE, "w")  # held until the process ends
    hold(alive)
    atexit.register(_end, folder, alive)
    return Cache(folder, int(os.environ.get(BYTES) or DEFAULT_BYTES))


def _end(folder: Path, alive) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    alive.close()


def _clear_the_dead(root: Path) -> None:
    for folder in root.iterdir():
        try:
            with open(folder / _ALIVE) as alive:
                if try_to_hold(alive):
                    shutil.rmtree(folder, ignore_errors=True)
        except OSError:  # it is just being made, or is none of ours
            continue
