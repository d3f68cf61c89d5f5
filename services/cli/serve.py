"""`splatpress serve`: API and runner as processes side by side."""

from __future__ import annotations

import errno
import os
import shlex
import signal
import socket
import sys
import tempfile
import threading
import time

from services.cli.commands.running import program
from services.cli.supervise import alone_on, keep_running
from services.jobs.disk import make_data_folder
from services.jobs.heartbeat import dashboard, runner_age_s, show_gone
from services.settings import ServiceSettings, environment_of

READY_S = 120.0
PARTS = ("api", "runner")
EVERYWHERE = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}  # all addresses of this machine, and its own loopback


def run_api(settings: ServiceSettings) -> None:
    """The web part of the service, until it is stopped."""
    import uvicorn

    from services.api.app import create_app
    from services.api.door.connection import protocol

    make_data_folder(settings)
    tempfile.tempdir = str(settings.data / "incoming")  # bodies of a form: as large as scans, so on the disk for scans
    uvicorn.run(
        create_app(settings),
        host=settings.host,
        port=settings.port,
        log_level="info" if settings.access_log else "warning",
        access_log=settings.access_log,
        timeout_graceful_shutdown=3,
        server_header=False,
        http=protocol(settings.headers_s),
        ws="websockets-sansio",  # Dask's pages
    )


def serve(settings: ServiceSettings) -> int:
    """Until SIGTERM or SIGINT. Raises OSError where the port or the data folder is another's."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    make_data_folder(settings)
    with alone_on(settings.data, address(settings)):
        _check_port(settings)
        show_gone(settings.place)
        threading.Thread(target=_announce, args=(settings, stop), daemon=True).start()
        return keep_running(PARTS, {**os.environ, **environment_of(settings)}, stop)


def address(settings: ServiceSettings) -> str:
    """That a browser on this machine can open."""
    host = EVERYWHERE.get(settings.host, settings.host)
    return f"http://{f'[{host}]' if ':' in host and not host.startswith('[') else host}:{settings.port}"


def _check_port(settings: ServiceSettings) -> None:
    """Starting the API again and again would not help."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        with socket.create_server((settings.host, settings.port), family=family):
            pass
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            raise
        text = f"port {settings.port} of {settings.host} is already in use; take another with --port"
        raise OSError(errno.EADDRINUSE, text) from None


def _announce(settings: ServiceSettings, stop: threading.Event) -> None:
    print("starting; addresses stand here once jobs can run", file=sys.stderr, flush=True)
    deadline = time.monotonic() + READY_S
    while runner_age_s(settings.place) is None and time.monotonic() < deadline and not stop.wait(0.2):
        pass
    if stop.is_set():
        return
    base = address(settings)
    for what, url in (
        ("job page", base + "/"),
        ("API", base + "/v1/openapi.json"),
        ("API docs", base + "/docs"),
        ("Dask dashboard", base + "/dashboard" if dashboard(settings.place) else ""),
        ("data", settings.objects or str(settings.data)),
    ):
        print(f"{what:<15} {url}", flush=True)
    print(*_next_steps(settings, base), sep="\n", flush=True)


def _next_steps(settings: ServiceSettings, base: str) -> list[str]:
    """What to do once it runs, as lines for a shell: alone on this machine, or with a token for each."""
    if not settings.needs_tokens:
        return [f"next            open the job page, or: {program()} submit SCAN --url {base} --watch"]
    away = f"http://{socket.gethostname()}:{settings.port}" if settings.host in EVERYWHERE else base
    return [
        f"from elsewhere  {away}/, where the network knows this machine by that name",
        f"tokens          {program()} token OWNER --data {shlex.quote(str(settings.data))}",
        f"next            a token for each person, who then says once: splatpress login --url {away}",
    ]
