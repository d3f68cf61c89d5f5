"""`splatpress map`: the maps of a laser scan's stations as pictures."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

from pipeline.planning.settings import Settings
from pipeline.readers.attributes.options import ReadOptions
from services.cli.arguments import WrongArgument, add_knobs, settings_of

READING = ("station", "marked_points")  # knobs of how a laser scan is read


def add_map(commands, add_executor, add_output) -> None:
    """The verb; `add_executor` adds where it runs, `add_output` where it writes."""
    maps = commands.add_parser("map", help="what each station of a laser scan saw, as pictures to edit")
    maps.add_argument("scan", metavar="SCAN")
    add_output(maps)
    add_knobs(maps, READING)
    add_executor(maps)
    maps.add_argument("--json", action="store_true", help="a row a station as the last line of stdout")
    maps.set_defaults(command=_map, preset="balanced")


def add_edited_maps(compress: argparse.ArgumentParser) -> None:
    compress.add_argument(
        "--maps", metavar="DIR", help="pictures of stations that `map` wrote and somebody edited: texture from these"
    )


def settings_with_maps(options: argparse.Namespace) -> Settings:
    """The settings; edited maps ask for the texture that they are for. Raises WrongArgument where another is asked for."""
    settings = settings_of(options)
    if not options.maps:
        return settings
    if settings.texture == "color":
        raise WrongArgument("--maps with --texture color, which shows none of them; allowed: --texture auto, atoms")
    return replace(settings, texture="atoms")


def _map(options: argparse.Namespace) -> int:
    from services.cli.main import _executor, _progress, _refuse_to_overwrite, _scan_path
    from services.processes.map import map_scan

    reading: ReadOptions = settings_of(options).reading
    scan, out = _scan_path(options.scan), Path(options.out)
    _refuse_to_overwrite(out, options.overwrite)
    work = Path(options.work) if options.work else None
    with _executor(options) as executor:
        rows = map_scan(scan, out, executor, _progress(), reading=reading, work=work)
    print(json.dumps(rows) if options.json else as_text(rows, out))
    return 0


def as_text(rows: list[dict], out: Path) -> str:
    """A line a station, and what to do with the pictures."""
    lines = []
    for row in rows:
        if not row["files"]:
            lines.append(f"station {row['station']}: no point from which a map could be drawn")
            continue
        centre = ", ".join(f"{x:g}" for x in row["centre"])
        lines.append(
            f"station {row['station']} at {centre}: steps of {row['step_degrees']:.3g} degrees, {row['covered']:.0%} covered, "
            f"{out / row['files'][0]}"
        )
    return "\n".join(
        [*lines, f"edit the pictures, then: splatpress compress SCAN --maps {out} --density 0.1 --out DIR"]
    )
