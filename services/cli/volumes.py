"""`splatpress iso`: which surfaces a volume holds."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from services.cli.arguments import WrongArgument

ROWS, WIDTH = 32, 40  # of the printed histogram


def add_iso(commands, add_executor) -> None:
    """The verb; `add_executor` adds where it runs."""
    iso = commands.add_parser("iso", help="the histogram of a volume, and the iso values that it proposes")
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
    from services.cli.main import _executor, _progress, _scan_path
    from services.processes.inspect import iso_values

    try:
        choice = Choice(options.component, options.time, parse_spacing(options.spacing or ""))
    except ValueError as error:
        raise WrongArgument(str(error)) from error
    path = _scan_path(options.volume)
    with _executor(options) as executor:
        found = iso_values(path, choice, executor, _progress(), Path(options.work) if options.work else None)
    print(json.dumps(found) if options.json else as_text(found))
    return 0


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
