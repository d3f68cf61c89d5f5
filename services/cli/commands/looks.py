"""Verbs that look at what a scan holds: `iso`, the surfaces of a volume; `map`, what a laser scan's stations saw."""

from __future__ import annotations

import argparse
import json
import shlex
from dataclasses import replace
from pathlib import Path

from pipeline.planning.settings import Settings
from pipeline.readers.attributes.options import ReadOptions
from services.cli.arguments import add_knobs, settings_of
from services.cli.commands.options import add_executor, add_output
from services.cli.commands.running import executor_for, progress_bars, refuse_to_overwrite, scan_path
from services.cli.exit_codes import OK
from services.cli.parser import WrongArgument

ROWS, WIDTH = 32, 40  # of the printed histogram
READING = ("station", "marked_points")  # knobs of how a laser scan is read


def add_iso(commands) -> None:
    """The verb `iso`."""
    iso = commands.add_parser("iso")
    iso.add_argument("volume", metavar="VOLUME")
    iso.add_argument("--component", type=int, metavar="N", help="which number of a voxel, of several")
    iso.add_argument("--time", type=int, metavar="N", help="which time, of several")
    iso.add_argument("--spacing", metavar="I,J,K", help="of voxels, in place of what the file says")
    iso.add_argument("--work", metavar="DIR", help="keep the stages' outputs there, and use what is there already")
    iso.add_argument("--json", action="store_true", help="all of it as the last line of stdout")
    add_executor(iso)
    iso.set_defaults(command=_iso)


def _iso(options: argparse.Namespace) -> int:
    from pipeline.volumes.request import parse_spacing
    from pipeline.volumes.volume import Choice
    from services.processes.inspect import iso_values

    try:
        choice = Choice(options.component, options.time, parse_spacing(options.spacing or ""))
    except ValueError as error:
        raise WrongArgument(str(error)) from error
    path = scan_path(options.volume)
    with executor_for(options) as executor:
        found = iso_values(path, choice, executor, progress_bars(), Path(options.work) if options.work else None)
    print(json.dumps(found) if options.json else as_text(found))
    return OK


def as_text(found: dict) -> str:
    """The histogram, the proposals, and the command that takes them."""
    volume = found["volume"]
    lines = [
        f"{' x '.join(map(str, volume['shape']))} voxels of {volume['dtype']}, {' x '.join(f'{x:g}' for x in volume['spacing'])} "
        f"{volume['unit']}, values {volume['low']:g} to {volume['high']:g}, frame: {volume['frame']}",
        *(f"warning: {text}" for text in volume["warnings"]),
        "",
        f"{'values':>23} {'voxels':>13} {'crossings':>13} {'steepness':>10}",
        *_histogram(found),
        "",
    ]
    if found["is_labels"]:
        lines.append(
            "values seem to be names of regions, not grey levels: surfaces between them are those of whole regions"
        )
    if not found["proposals"]:
        return "\n".join([*lines, "no value is passed steeply: nothing to propose"])
    for proposal in found["proposals"]:
        lines.append(
            f"iso {proposal['iso']:<10g} {proposal['pairs']:>12,} crossings, {proposal['steepness']:.3g} a voxel"
            f"   --iso {proposal['iso']:g}"
        )
    return "\n".join(lines)


def _histogram(found: dict) -> list[str]:
    edges, n = found["edges"], len(found["voxels"])
    used = [i for i in range(n) if found["voxels"][i] or found["pairs"][i]]
    last = used[-1] + 1 if used else 1
    step = -(-last // ROWS)
    rows = [(i, min(i + step, last)) for i in range(0, last, step)]
    most = max(max(found["pairs"][a:b]) for a, b in rows) or 1
    lines = []
    for a, b in rows:
        pairs = max(found["pairs"][a:b])
        steepness = max(found["steepness"][a:b])
        bar = "#" * round(WIDTH * pairs / most)
        lines.append(
            f"{edges[a]:>11.4g} {edges[b]:>11.4g} {sum(found['voxels'][a:b]):>13,} {pairs:>13,} {steepness:>10.3g} {bar}"
        )
    return lines


# --- maps -----------------------------------------------------------------------------------------------------------


def add_map(commands) -> None:
    """The verb `map`."""
    maps = commands.add_parser("map")
    maps.add_argument("scan", metavar="SCAN")
    add_output(maps)
    add_knobs(maps, READING)
    add_executor(maps)
    maps.add_argument("--json", action="store_true", help="a row a station as the last line of stdout")
    maps.set_defaults(command=_map, preset="balanced")


def add_edited_maps(compress: argparse.ArgumentParser) -> None:
    """The option `--maps`."""
    compress.add_argument(
        "--maps", metavar="DIR", help="pictures of stations that `map` wrote and somebody edited: texture from these"
    )


def settings_with_maps(options: argparse.Namespace) -> Settings:
    """The settings; edited maps ask for the texture that they are for. Raises WrongArgument where another is asked
    for."""
    settings = settings_of(options)
    if not options.maps:
        return settings
    if settings.texture == "color":
        raise WrongArgument(
            "--maps with --texture color, which shows none of them; allowed: --texture auto, atoms, map"
        )
    return settings if settings.texture == "map" else replace(settings, texture="atoms")


def _map(options: argparse.Namespace) -> int:
    from services.flow.map_pictures import map_scan

    reading: ReadOptions = settings_of(options).reading
    scan, out = scan_path(options.scan), Path(options.out)
    refuse_to_overwrite(out, options.overwrite)
    work = Path(options.work) if options.work else None
    with executor_for(options) as executor:
        rows = map_scan(scan, out, executor, progress_bars(), reading=reading, work=work)
    print(json.dumps(rows) if options.json else maps_as_text(rows, out))
    return OK


def maps_as_text(rows: list[dict], out: Path) -> str:
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
        [
            *lines,
            f"edit the pictures, then: splatpress compress SCAN --maps {shlex.quote(str(out))} --density 0.1 --out DIR",
        ]
    )
