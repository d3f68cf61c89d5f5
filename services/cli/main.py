"""The command line: one command of the table in `commands/`, and what an error of any of them ends with.

Exit codes stand in `exit_codes.py`. Commands import what is heavy within their functions, so that their --help and
inspect answer at once.
"""

from __future__ import annotations

import io
import os
import sys
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from services.cli.exit_codes import ARGUMENTS, INPUT_OUTPUT, INTERNAL, INTERRUPTED, OK, TERMINATED
from services.cli.parser import Commands, WrongArgument
from storage.errors import SplatpressError


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files are bytes, and may be no text
    options = Commands().parsed(arguments)
    warnings.filterwarnings("ignore", module="zarr")
    try:
        with _terminable():
            return options.command(options)
    except SplatpressError as error:
        from services.cli.wording import as_options

        said = str(error) if hasattr(error, "problem") else as_options(str(error))  # a service has options by name
        print(f"splatpress: {error.title}: {said}", file=sys.stderr)
        _print_notes(error)
        return error.exit_code
    except WrongArgument as error:
        print(f"splatpress: {error}", file=sys.stderr)
        return ARGUMENTS
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except OSError as error:
        print(f"splatpress: {error}", file=sys.stderr)
        _print_notes(error)
        return INPUT_OUTPUT
    except MemoryError:
        print("splatpress: resource error: memory ran out; allowed: as much as the machine has", file=sys.stderr)
        return INPUT_OUTPUT
    except KeyboardInterrupt:
        print("splatpress: interrupted", file=sys.stderr)
        return INTERRUPTED
    except Terminated:
        print("splatpress: terminated", file=sys.stderr)
        return TERMINATED
    except Exception as error:
        if type(error).__module__.startswith("httpx"):
            print(f"splatpress: no answer from {_asked(error)}: {error}", file=sys.stderr)
            return INPUT_OUTPUT
        if type(error).__module__.startswith("sqlalchemy"):
            from services.problems import is_of_database

            if is_of_database(error):
                print(
                    f"splatpress: resource error: the database does not answer: {getattr(error, 'orig', error)}",
                    file=sys.stderr,
                )
                return INPUT_OUTPUT
        # Whatever else comes here is ours to mend, and must not look like wrong arguments.
        traceback.print_exc()
        print("splatpress: internal error: please report the lines above", file=sys.stderr)
        return INTERNAL


class Terminated(BaseException):
    """SIGTERM came: what was begun is cleared away, as at Ctrl-C."""


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM raises Terminated meanwhile; commands that run until it comes take it for themselves."""
    import signal
    import threading

    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(*_) -> None:
        raise Terminated

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _print_notes(error: Exception) -> None:
    """What an error says besides, as that a packed file was kept."""
    for note in getattr(error, "__notes__", ()):
        print(f"splatpress: {note}", file=sys.stderr)


def _asked(error: Exception) -> str:
    """The service that an error of httpx is about."""
    try:
        return str(error.request.url.copy_with(path="/", query=None))  # type: ignore[attr-defined]
    except (RuntimeError, AttributeError):  # it is about none
        return "the service"


if __name__ == "__main__":
    sys.exit(main())
