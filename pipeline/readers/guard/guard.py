"""Calls of readers in a process of their own, which may die: then the scan is invalid, and whoever asked lives on.

LAZ and E57 are parsed by libraries that end their process on some broken bytes. A process serves one call after the other;
a generator has one to itself until it ends.
"""

from __future__ import annotations

import atexit
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path

from pipeline.readers.attributes.looks import Looks
from pipeline.readers.guard.worker import END, ERROR, ITEM, MEMORY, receive, send
from pipeline.scan import Piece, ScanSource
from storage.errors import InvalidScan, ResourceExhausted

SECONDS = 8.0  # of processor time, for an answer or a piece; and one more for BYTES_A_SECOND of the file
BYTES_A_SECOND = 50e6
MEMORY_BYTES = 1 << 30  # and MEMORY_SHARE of the file
MEMORY_SHARE = 2

_ROOT = str(Path(__file__).resolve().parents[3])
_idle: list[_Worker] = []
_lock = threading.Lock()


@dataclass
class _Worker:
    process: subprocess.Popen
    connection: Connection
    owner: int  # of the process that started it: a fork must leave it alone

    def end(self) -> None:
        self.connection.close()
        self.process.kill()
        self.process.wait()


def _start() -> _Worker:
    here, there = socket.socketpair()
    with there:
        os.set_inheritable(there.fileno(), True)
        command = [sys.executable, "-m", "pipeline.readers.guard.worker", str(there.fileno())]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([_ROOT, *filter(None, sys.path)])}
        process = subprocess.Popen(
            command,
            pass_fds=[there.fileno()],
            env=environment,
            stdin=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,  # a panic prints lines of its own
        )
    return _Worker(process, Connection(here.detach()), os.getpid())


def _take() -> _Worker:
    with _lock:
        while _idle:
            worker = _idle.pop()
            if worker.owner == os.getpid() and worker.process.poll() is None:
                return worker
    return _start()


@atexit.register
def _end_idle() -> None:
    while _idle:
        worker = _idle.pop()
        if worker.owner == os.getpid():
            worker.end()


def _give(worker: _Worker) -> None:
    with _lock:
        _idle.append(worker)


def _died(worker: _Worker, where: str, seconds: float) -> InvalidScan:
    worker.end()
    code = worker.process.returncode
    if code == -signal.SIGPROF:
        return InvalidScan(where, f"takes more than {seconds:.0f} s of processor time to read on", "a whole file")
    reason = signal.Signals(-code).name if code < 0 else f"exit status {code}"
    return InvalidScan(where, f"crashes its reader ({reason})", "a whole file", "the file may be damaged")


def _limits(path: str) -> tuple[float, int]:
    n_bytes = os.path.getsize(path)
    return SECONDS + n_bytes / BYTES_A_SECOND, MEMORY_BYTES + MEMORY_SHARE * n_bytes


def iterate(path: str, function: Callable[..., Iterator], *arguments) -> Iterator:
    """What a generator function yields for a file; it runs ahead of whoever takes its items.

    Raises: what it raises; InvalidScan where its process dies, ResourceExhausted where it needs too much memory.
    """
    worker, (seconds, n_bytes), is_whole = _take(), _limits(path), False
    try:
        send(worker.connection, ITEM, (function, arguments, seconds, n_bytes))
        while True:
            kind, value = receive(worker.connection)
            if kind == ITEM:
                yield value
                continue
            is_whole = True
            if kind == ERROR:
                raise value  # type: ignore[misc]
            if kind == MEMORY:
                found = f"needs more than {n_bytes >> 20:,} MiB to read"
                raise ResourceExhausted(path, found, "files that say what they hold", "the file may be damaged")
            if kind != END:
                yield value
            return
    except (EOFError, ConnectionError) as error:
        raise _died(worker, path, seconds) from error
    finally:
        if is_whole:
            _give(worker)
        elif worker.process.returncode is None:
            worker.end()


def call(path: str, function: Callable, *arguments):
    """What a function returns for a file. Raises: as `iterate`."""
    return next(iterate(path, function, *arguments))


def guarded(source: ScanSource) -> ScanSource:
    """The scan whose points and photographs are read elsewhere."""
    path = source.path
    return replace(
        source,
        pieces=partial(_pieces, path, source.pieces),
        read_slice=source.read_slice and partial(_pieces, path, source.read_slice),
        settle=source.settle and partial(_settled, source.settle),
        read_photo=source.read_photo and partial(call, path, source.read_photo),
    )


def _pieces(path: str, read: Callable[..., Iterator[Piece]], *arguments: int) -> Iterator[Piece]:
    return iterate(path, read, *arguments)


def _settled(settle: Callable[[Looks], ScanSource | None], looks: Looks) -> ScanSource | None:
    settled = settle(looks)
    return settled and guarded(settled)
