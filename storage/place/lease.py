"""One holder of a name at a time: a kernel's lock on a folder of this machine, a lease in a bucket.

A lease is an object that its holder writes anew every few seconds, each time on condition that it is still the one it
wrote last (`If-Match`). Who waits takes over what has not changed for LEASE_S by the waiter's own clock, so no two
clocks have to agree. A holder that was paused for longer finds its lease gone; what it then still writes are the same
bytes as its successor's.
"""

from __future__ import annotations

import json
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from storage.file_lock import try_to_hold
from storage.place import objects
from storage.place.objects import Taken, is_remote

POLL_S = 0.2
LEASE_S, RENEW_S = 20.0, 4.0


@contextmanager
def alone(path: Path, check: Callable[[], None] = lambda: None, poll_s: float = POLL_S) -> Iterator[None]:
    """Hold `path`, a file beside what it guards; `check` is called while another holds it, and may raise."""
    with try_alone(path) as attempt:
        while True:
            check()
            if attempt():
                break
            time.sleep(poll_s)
        yield


@contextmanager
def try_alone(path: Path) -> Iterator[Callable[[], bool]]:
    """A function that tries to take hold of `path`, and says whether it did; held until the end of the block."""
    if is_remote(path):
        lease = _Lease(path)
        try:
            yield lease.take
        finally:
            lease.free()
        return
    with open(path, "w") as lock:
        yield lambda: try_to_hold(lock)


@dataclass
class _Lease:
    path: Path
    holder: str = field(default_factory=lambda: uuid.uuid4().hex)
    _tag: str = ""
    _beat: int = 0
    _seen: tuple[str, float] = ("", 0.0)  # another's tag, and since when it has not changed
    _stop: threading.Event = field(default_factory=threading.Event)
    _renewing: threading.Thread | None = None

    def take(self) -> bool:
        if self._tag:
            return True
        try:
            content, tag = objects.get(self.path)
        except FileNotFoundError:
            return self._write(None)
        if json.loads(content)["holder"]:
            if tag != self._seen[0]:
                self._seen = (tag, time.monotonic())
            if time.monotonic() - self._seen[1] < LEASE_S:
                return False
        return self._write(tag)

    def _write(self, over: str | None, holder: str | None = None) -> bool:
        """On condition that `over` is there; an answer that was lost is found out by reading what is there."""
        self._beat += 1
        content = json.dumps(
            {"holder": self.holder if holder is None else holder, "beat": self._beat, "by": self.holder}
        )
        try:
            self._tag = objects.put(self.path, content.encode(), over)
        except Taken:
            try:
                there, tag = objects.get(self.path)
            except FileNotFoundError:
                there, tag = b"", ""
            self._tag = tag if there == content.encode() else ""
        if self._tag and self._renewing is None:
            self._renewing = threading.Thread(target=self._renew, daemon=True)
            self._renewing.start()
        return bool(self._tag)

    def _renew(self) -> None:
        while not self._stop.wait(RENEW_S):
            try:
                if not self._write(self._tag):
                    return
            except OSError:  # the server is away: the lease stands until another takes it over
                continue

    def free(self) -> None:
        """Written, not removed: a bucket removes without a condition."""
        self._stop.set()
        if self._renewing is not None:
            self._renewing.join()
        if self._tag:
            try:
                self._write(self._tag, holder="")
            except OSError:
                pass  # it runs out
