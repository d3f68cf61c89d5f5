"""What commands do before and while they run: where, with what progress, on which scan."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

from pipeline.planning.settings import Settings
from services.cli.parser import WrongArgument
from storage.errors import InvalidScan, ResourceExhausted


def executor_for(options: argparse.Namespace, beside_start: Callable[[], object] = lambda: None):
    """What runs the tasks of a command with these options; `beside_start` is called while its processes start."""
    from pipeline.execution.executors import DaskExecutor, SerialExecutor

    if options.executor == "serial":
        return SerialExecutor()
    return DaskExecutor(options.workers, options.scheduler, beside_start=beside_start)


def progress_bars():
    """What shows on the terminal how stages come on."""
    from services.cli.progress import ProgressBars

    return ProgressBars()


def scan_path(text: str) -> Path:
    """The path of a file or folder. Raises: FileNotFoundError where it is not there."""
    path = Path(text)
    if not path.exists():
        raise FileNotFoundError(f"{text}: no such file or folder")
    return path


def look_first(scan: Path, draws: bool, settings: Settings) -> None:
    """What takes a second is looked at before workers start: the scan's header, and OpenGL where pictures are
    wanted."""
    from services.processes.inspect import inspect_input

    inspect_input(scan, settings.reading, settings.choice)
    look_at_opengl(draws)


def look_at_opengl(draws: bool) -> None:
    """Raises ResourceExhausted where pictures are wanted and cannot be drawn."""
    from renderer.splats.context import gl_context

    if draws:
        try:
            gl_context().release()
        except ResourceExhausted as error:
            raise ResourceExhausted(
                error.where, error.found, error.allowed, f"{error.hint}; or go without pictures: --no-render"
            ) from error


def needs_photographs(scan: Path, settings: Settings, why: str) -> None:
    """Told by the header, before workers start."""
    from services.processes.inspect import inspect_input

    if not inspect_input(scan, settings.reading, settings.choice).get("cameras", {}).get("count"):
        raise InvalidScan(str(scan), "no photographs", f"a scan with photographs: {why}")


def made_folder(folder: Path) -> Path:
    """The folder, made with its parents where it was not there."""
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def program() -> str:
    """What a shell calls this program by: its name where PATH leads to it, else the path it was called by, quoted."""
    called, name = Path(sys.argv[0]), "splatpress"
    if called.name != name or not called.is_file():  # a module of Python
        return name
    import shutil

    found = shutil.which(name)
    return name if found and called.samefile(found) else shlex.quote(sys.argv[0])


def asked_token() -> str:
    """What is typed, unseen, where a person sits there; else the first line of stdin."""
    import getpass

    return getpass.getpass("token (empty for none): ") if sys.stdin.isatty() else sys.stdin.readline().strip()


def refuse_to_overwrite(out: Path, overwrite: bool) -> None:
    """Raises: WrongArgument where `out` has something in it, and nobody said that it may go."""
    if out.exists() and not overwrite and (not out.is_dir() or any(out.iterdir())):
        raise WrongArgument(f"--out {out} exists and is not empty; choose another, or say --overwrite")
