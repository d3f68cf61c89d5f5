"""The parts of a service as processes: each started anew when it dies, all of them gone when their supervisor is, and
one supervisor a data folder."""

from __future__ import annotations

import errno
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from storage.file_lock import try_to_hold

RESTART_S = 1.0
STOP_S = 10.0
TRIES, HARDLY_BEGUN_S = 5, 20.0  # a part that ends so often so soon after its start has no way to run


@contextmanager
def alone_on(data: Path, url: str) -> Iterator[None]:
    """Raises OSError naming the service that has the folder already."""
    with open(data / "serve.lock", "a+") as lock:
        if not try_to_hold(lock):
            raise OSError(errno.EBUSY, f"{data} is served already, {_first(data)}; stop it, or take another --data")
        lock.truncate(0)
        lock.write(json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "url": url}))
        lock.flush()
        yield


def _first(data: Path) -> str:
    try:
        found = json.loads((data / "serve.lock").read_text())
        return f"by process {found['pid']} of {found['host']} at {found['url']}"
    except (OSError, ValueError, KeyError):
        return "by another process"


def keep_running(parts: tuple[str, ...], environment: dict[str, str], stop: threading.Event) -> int:
    """Until `stop` is set: 0; or until a part ends again and again right after its start: its exit code."""
    running = {part: _start(part, environment) for part in parts}
    begun, failed = {part: time.monotonic() for part in parts}, dict.fromkeys(parts, 0)
    try:
        while not stop.wait(RESTART_S):
            for part, process in running.items():
                if (status := process.poll()) is None:
                    continue
                failed[part] = failed[part] + 1 if time.monotonic() - begun[part] < HARDLY_BEGUN_S else 1
                if failed[part] >= TRIES:
                    _say(f"{part} ended with {status}, {TRIES} times right after its start; see above for why")
                    return status if status > 0 else 4
                _say(f"{part} ended with {status}; starting it anew")
                running[part], begun[part] = _start(part, environment), time.monotonic()
        return 0
    finally:
        _stop(list(running.values()))


def _say(text: str) -> None:
    print(f"splatpress: {text}", file=sys.stderr, flush=True)


def _start(part: str, environment: dict[str, str]) -> subprocess.Popen:
    """In a session of its own: Ctrl-C reaches the parts through this process, in order."""
    return subprocess.Popen(
        [sys.executable, "-m", "services.cli.main", part, "--end-with-stdin"],
        env=environment,
        start_new_session=True,
        stdin=subprocess.PIPE,
    )


def end_with_stdin() -> None:
    """Let this process end once its standard input does: where the supervisor is killed outright, its parts go too."""

    def wait() -> None:
        while os.read(0, 1 << 10):  # not through sys.stdin, whose lock this thread would hold when the process ends
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()


def _stop(processes: list[subprocess.Popen]) -> None:
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + STOP_S
    for process in processes:
        try:
            process.wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
