"""Options that several commands have, and the kinds of their values."""

from __future__ import annotations

import argparse

from pipeline.planning.settings import DEFAULT_PRESET
from services.cli.arguments import add_knobs
from storage.packed.schema import MAX_ATOMS


def count(text: str) -> int:
    """A whole number from 1 on."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 on")
    return int(text)


def count_or_none(text: str) -> int:
    """A whole number from 0 to a million."""
    if not text.isdigit() or int(text) > 1_000_000:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 to 1,000,000")
    return int(text)


def megapixels(text: str) -> float:
    """Millions of pixels of a photograph, above 0, to 10,000."""
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0 < number <= 1e4:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of megapixels above 0, to 10,000")
    return number


def atoms_a_splat(text: str) -> float:
    """Atoms that a splat takes on average, 0 to MAX_ATOMS."""
    try:
        number = float(text)
    except ValueError:
        number = -1.0
    if not 0 <= number <= MAX_ATOMS:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of atoms from 0 to {MAX_ATOMS}")
    return number


def large_count(text: str) -> int:
    """A number of splats from 1 to 1e12, as 71e6."""
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 1 <= number <= 1e12:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of splats from 1 to 1e12")
    return int(number)


def color(text: str) -> tuple[int, int, int]:
    """A colour (red, green, blue) of #RRGGBB."""
    digits = text.removeprefix("#")
    try:
        if len(digits) != 6:
            raise ValueError
        red, green, blue = bytes.fromhex(digits)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no colour; allowed: #RRGGBB, as #ffffff") from None
    return red, green, blue


def size(text: str) -> tuple[int, int]:
    """Width and height in px, from 1x1 to 16384x16384."""
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, as 1280x720") from None
    if not (1 <= width <= 16384 and 1 <= height <= 16384):
        raise argparse.ArgumentTypeError(f"{text} is out of range; allowed: 1x1 to 16384x16384")
    return width, height


def direction(text: str) -> tuple[float, float, float]:
    """Three finite numbers, right, up and towards the viewer, that are not all 0."""
    try:
        right, up, towards = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no direction; allowed: three numbers with commas, as 1,1,1"
        ) from None
    if not 0 < right * right + up * up + towards * towards < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is no direction; allowed: three finite numbers, one of them not 0")
    return right, up, towards


def add_reading(command: argparse.ArgumentParser) -> None:
    """The knobs of reading, for commands that only read."""
    command.set_defaults(preset=DEFAULT_PRESET)
    add_knobs(command, ("marked_points", "station", "sparse_model", "height_scale", "spacing", "component", "time"))


def add_strict(command: argparse.ArgumentParser) -> None:
    """The option `--strict`."""
    command.add_argument("--strict", action="store_true", help="warnings about the scan are errors: exit with 3")


def add_output(command: argparse.ArgumentParser) -> None:
    """Where a command writes: `--out`, `--overwrite`, `--work`."""
    command.add_argument("--out", required=True, metavar="DIR")
    command.add_argument("--overwrite", "-w", action="store_true", help="replace what is in DIR")
    add_work(command)


def add_work(command: argparse.ArgumentParser) -> None:
    """The option `--work`."""
    command.add_argument("--work", metavar="DIR", help="keep the stages' outputs there, and use what is there already")


def add_running(command: argparse.ArgumentParser) -> None:
    """Options of commands that make a report: where they run, and the gate that it has to pass."""
    add_measuring(command)
    command.add_argument("--require-psnr-db", type=float, metavar="DB", help="exit with 7 below this texture PSNR")


def add_executor(command: argparse.ArgumentParser) -> None:
    """Where a command runs: `--workers`, `--executor`, `--scheduler`."""
    command.add_argument("--workers", type=count, metavar="N", help="worker processes; default: one a core")
    command.add_argument("--executor", choices=("dask", "serial"), default="dask")
    command.add_argument("--scheduler", metavar="tcp://...", help="a running Dask scheduler")


def add_measuring(command: argparse.ArgumentParser) -> None:
    """Options of commands that measure: where they run, `--no-render`, `--json`."""
    add_executor(command)
    command.add_argument("--no-render", action="store_true", help="no pictures: needs no OpenGL")
    command.add_argument("--json", action="store_true", help="what was measured as the last line of stdout")
