"""`splatpress serve`: API and runner as processes side by side, each started anew when it dies."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time

from services.jobs.disk import make_data_folder
from services.jobs.heartbeat import dashboard, runner_age_s, show_gone
from services.settings import ServiceSettings, environment_of

RESTART_S = 1.0
STOP_S = 10.0
READY_S = 120.0
PARTS = ("api", "runner")


def run_api(settings: ServiceSettings) -> None:
    import uvicorn

    from services.api.app import create_app
    from services.api.connection import protocol

    make_data_folder(settings.data)
    tempfile.tempdir = str(settings.data / "incoming")  # bodies of a form: as large as scans, so on the disk for scans
    uvicorn.run(
        create_app(settings),
        host=settings.host,
        port=settings.port,
        log_level="warning",
        timeout_graceful_shutdown=3,
        server_header=False,
        http=protocol(settings.headers_s),
    )


def serve(settings: ServiceSettings) -> int:
    """Until SIGTERM or SIGINT."""
    _check_port(settings)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    make_data_folder(settings.data)
    show_gone(settings.data)
    environment = {**os.environ, **environment_of(settings)}
    running = {part: _start(part, environment) for part in PARTS}
    threading.Thread(target=_announce, args=(settings, stop), daemon=True).start()
    while not stop.wait(RESTART_S):
        for part, process in running.items():
            if process.poll() is not None:
                print(
                    f"splatpress: {part} ended with {process.returncode}; starting it anew", file=sys.stderr, flush=True
                )
                running[part] = _start(part, environment)
    _stop(list(running.values()))
    return 0


def _check_port(settings: ServiceSettings) -> None:
    """Raises OSError where another service has it: starting the API again and again would not help."""
    with socket.create_server(
        (settings.host, settings.port), family=socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    ):
        pass


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
        sys.stdin.buffer.read()
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


def _announce(settings: ServiceSettings, stop: threading.Event) -> None:
    deadline = time.monotonic() + READY_S
    while runner_age_s(settings.data) is None and time.monotonic() < deadline and not stop.wait(0.2):
        pass
    base = f"http://{settings.host}:{settings.port}"
    for what, url in (
        ("job page", base + "/"),
        ("API", base + "/v1"),
        ("API docs", base + "/docs"),
        ("Dask dashboard", dashboard(settings.data)),
        ("data", str(settings.data)),
    ):
        print(f"{what:<15} {url}", flush=True)
    if settings.needs_tokens:
        print("every request needs a token: splatpress token OWNER --data DIR", flush=True)
