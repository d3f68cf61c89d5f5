"""The commands that draw a packed file: `render` and `coverage`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from services.cli.arguments import add_view_knobs
from services.cli.commands.options import color, count, direction, size
from services.cli.commands.running import scan_path
from services.cli.exit_codes import OK
from services.cli.parser import WrongArgument


def add_render(commands) -> None:
    """The verb `render`."""
    render = commands.add_parser("render")
    render.add_argument("packed", metavar="PACKED")
    add_view = render.add_mutually_exclusive_group(required=True).add_argument
    add_view("--camera", metavar="NAME", help="one of the scan's cameras")
    add_view("--orbit", metavar="N", type=count, help="N pictures around the scan")
    add_view("--turntable", metavar="N", type=count, help="N pictures around the scan, and turntable.webp of them")
    render.add_argument(
        "--background", type=color, metavar="#RRGGBB", help="opaque pictures on that colour; default: transparent"
    )
    render.add_argument(
        "--front",
        action="store_true",
        help="leave out discs that show their backs, as is done where they are known to be hidden: closed surfaces of a volume, seen from outside",
    )
    render.add_argument("--size", type=size, metavar="WxH", help="default: the camera's own, or 1280x720")
    render.add_argument(
        "--light",
        type=direction,
        metavar="RIGHT,UP,TOWARDS",
        help="a distant lamp that way from the viewer, as 1,1,1; default: as photographed",
    )
    _add_up(render)
    add_view_knobs(render)
    render.add_argument("--out", required=True, metavar="DIR")
    render.set_defaults(command=_render)


def _add_up(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--up",
        type=direction,
        metavar="X,Y,Z",
        help="what is up in the scan's own axes, for views around it, as 0,1,0 or with = as --up=0,-1,0; default: "
        "by the photographs, else 0,0,1",
    )


def _render(options: argparse.Namespace) -> int:
    from renderer.effects.relighting import lamp
    from renderer.splats.detail import Detail
    from services.processes.render import render_views

    if options.front and options.pool_mib is not None:
        raise WrongArgument(
            "--front with --pool-mib; allowed: one of them, for groups that come and go are drawn from both sides"
        )
    paths = render_views(
        scan_path(options.packed),
        Path(options.out),
        camera=options.camera,
        n_orbit=options.turntable or options.orbit,
        animated=bool(options.turntable),
        background=options.background,
        size=options.size,
        max_atoms=options.atoms,
        precision=options.precision,
        antialias=options.antialias,
        light=lamp(*options.light) if options.light else None,
        up=options.up,
        detail=Detail(options.detail, options.most_splats),
        pool_mib=options.pool_mib,
        front_only=options.front,
    )
    for path in paths:
        print(path)
    return OK


def add_coverage(commands) -> None:
    """The verb `coverage`."""
    coverage = commands.add_parser("coverage")
    coverage.add_argument("packed", metavar="PACKED")
    _add_up(coverage)
    coverage.add_argument(
        "--pictures", metavar="DIR", help="the four views with their holes red, blue where the scan has no points"
    )
    coverage.add_argument("--json", action="store_true", help="what was measured as the last line of stdout")
    coverage.set_defaults(command=_coverage)


def _coverage(options: argparse.Namespace) -> int:
    from services.processes.render import coverage_of

    found = coverage_of(scan_path(options.packed), options.up, Path(options.pictures) if options.pictures else None)
    if options.json:
        print(json.dumps(found))
        return OK
    print(
        f"{'view':<12}{'holes':>9}{'behind':>9}{'before':>9}{'overdraw':>10}   of the surface, against discs of exact sizes"
    )
    for row in found["surface"]:
        shares = "".join(f"{100 * row[k]:8.2f}%" for k in ("holes", "see_through", "before"))
        print(f"{row['camera']:<12}{shares}{row['overdraw']:10.2f}")
    print(
        f"{'view':<12}{'covered':>9}{'holes':>9}{'uncovered':>11}{'unscanned':>11}   of the picture; inside the outline, closed by "
        "9x9 px; of these, with points of the scan on all sides, and without"
    )
    for row in found["outline"]:
        print(
            f"{row['camera']:<12}{100 * row['coverage']:8.2f}%{100 * row['holes']:8.2f}%{100 * row['uncovered']:10.2f}%"
            f"{100 * row['unscanned']:10.2f}%"
        )
    return OK
