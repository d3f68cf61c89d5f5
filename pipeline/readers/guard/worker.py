"""The process that parses strangers' bytes: it may run out of memory or time, or crash, and takes nobody with it.

`python -m pipeline.readers.guard.worker FD` answers calls on a socket until it is closed. Each answer, and each item of a
generator, may take so much processor time; the kernel ends the process that takes more.
"""

from __future__ import annotations

import os
import pickle
import resource
import signal
import sys
import types
from collections.abc import Callable
from multiprocessing.connection import Connection

VALUE, ITEM, END, ERROR, MEMORY = range(5)


def send(connection: Connection, kind: int, value: object) -> None:
    """A value with its arrays beside it, not copied into it."""
    buffers: list[pickle.PickleBuffer] = []
    body = pickle.dumps((kind, value), 5, buffer_callback=buffers.append)
    views = [buffer.raw() for buffer in buffers]
    connection.send_bytes(pickle.dumps([len(view) for view in views]))
    connection.send_bytes(body)
    for view in views:
        left = view
        while len(left):
            left = left[os.write(connection.fileno(), left) :]


def receive(connection: Connection) -> tuple[int, object]:
    """The inverse of `send`; arrays can be written to. Raises EOFError where the other end is gone."""
    sizes = pickle.loads(connection.recv_bytes())
    body = connection.recv_bytes()
    buffers = [bytearray(size) for size in sizes]
    for buffer in buffers:
        left = memoryview(buffer)
        while len(left):  # into its place: Connection.recv_bytes_into copies what it received once more
            if not (n := os.readv(connection.fileno(), [left])):
                raise EOFError
            left = left[n:]
    return pickle.loads(body, buffers=buffers)


def _limit_memory(n_bytes: int) -> None:
    """Beside what the process has mapped already."""
    try:
        with open("/proc/self/statm") as statm:
            mapped = int(statm.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (mapped + n_bytes, resource.getrlimit(resource.RLIMIT_AS)[1]))
    except (OSError, ValueError):
        pass  # a system without /proc


def _answer(connection: Connection, function: Callable, arguments: tuple, seconds: float) -> None:
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        value = function(*arguments)
        if not isinstance(value, types.GeneratorType):
            send(connection, VALUE, value)
            return
        for item in value:
            send(connection, ITEM, item)
            signal.setitimer(signal.ITIMER_PROF, seconds)
        send(connection, END, None)
    except MemoryError:
        send(connection, MEMORY, None)
    except Exception as error:
        send(connection, ERROR, error)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def main() -> None:
    """Answer calls on the connection that argv names until it closes, each within its own limits."""
    connection = Connection(int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever asks decides when to stop
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    while True:
        try:
            _, (function, arguments, seconds, n_bytes) = receive(connection)  # type: ignore[misc]
        except (EOFError, OSError):
            return
        _limit_memory(n_bytes)  # type: ignore[has-type]
        _answer(connection, function, arguments, seconds)  # type: ignore[has-type]


if __name__ == "__main__":
    main()
