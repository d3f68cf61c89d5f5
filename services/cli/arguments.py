"""What commands share: the arguments that the table of knobs makes, and the settings that they ask for."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection

from pipeline.planning.knobs import BY_NAME, KNOBS, VIEW_KNOBS, Knob
from pipeline.planning.settings import DEFAULT_PRESET, PRESETS, Settings, settings_for
from services.cli.parser import WrongArgument
from services.cli.wording import as_options


def add_settings(command: argparse.ArgumentParser, names: Collection[str] = BY_NAME) -> None:
    """--preset, and one argument a knob of those named; one that takes a list may be repeated, under its singular
    too."""
    add_preset(command)
    add_knobs(command, names)


def add_knobs(command: argparse.ArgumentParser, names: Collection[str]) -> None:
    """One argument a knob of those named."""
    for knob in (knob for knob in KNOBS if knob.name in names):
        argument = f"--{knob.name.replace('_', '-')}"
        spellings = tuple(dict.fromkeys((argument.removesuffix("s"), argument))) if knob.canonical else (argument,)
        command.add_argument(
            *spellings,
            dest=knob.name,
            metavar=_metavar(knob),
            action="append" if knob.canonical else "store",
            help=(knob.help if knob.choices else f"{knob.help} ({knob.allowed})").replace("%", "%%"),
        )


def add_preset(command: argparse.ArgumentParser) -> None:
    """The option `--preset`."""
    command.add_argument(
        "--preset",
        default=DEFAULT_PRESET,
        metavar="|".join(PRESETS),
        help=f"values of all knobs, from rough to exact; default: {DEFAULT_PRESET}",
    )


def add_view_knobs(command: argparse.ArgumentParser) -> None:
    """One argument a knob of a picture, of its kind; by default the first choice, or the most there is."""
    for knob in VIEW_KNOBS:
        command.add_argument(
            f"--{knob.name.replace('_', '-')}",
            type=_parser_of(knob),
            metavar=_metavar(knob),
            default=_usual(knob),
            help=f"{knob.help} ({knob.allowed})",
        )
    command.add_argument(
        "--max-atoms", dest="atoms", type=_parser_of(VIEW_KNOBS[0]), default=argparse.SUPPRESS, help=argparse.SUPPRESS
    )


def _usual(knob: Knob) -> object:
    """What a picture has of it where nobody asks."""
    if knob.usual is not None or knob.optional:
        return knob.usual
    return knob.choices[0] if knob.choices else knob.high


def _parser_of(knob: Knob) -> Callable[[str], object]:
    def parsed(text: str):
        try:
            return knob.parsed(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return parsed


def settings_of(options: argparse.Namespace) -> Settings:
    """The settings that the arguments of `add_settings` or `add_preset` ask for. Raises WrongArgument."""
    given = {name: text for name in BY_NAME if (text := getattr(options, name, None)) is not None}
    given = {name: text if isinstance(text, str) else ",".join(text) for name, text in given.items()}
    try:
        return settings_for(options.preset, **{name: BY_NAME[name].parsed(text) for name, text in given.items()})
    except ValueError as error:
        raise WrongArgument(as_options(str(error))) from error


def target_in_words(options: argparse.Namespace, textured: bool) -> str | None:
    """What `--target-psnr-db` means for a scan with textures and for one without; None where nobody gave it."""
    if (target := options.target_psnr_db) is None:
        return None
    if not textured:
        return f"--target-psnr-db {target} is not used: this scan gives colours, no textures"
    return f"target: a splat takes no further atom once it has {target} dB, so all of them together differ from it"


def _metavar(knob: Knob) -> str:
    if knob.canonical:
        return knob.metavar
    return "|".join(str(c) for c in knob.choices) if knob.choices else "N" if knob.kind is int else "X"
