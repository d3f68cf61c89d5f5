"""The verbs `pages`, `path` and `fly`: photographs in pages, and recorded paths that want some of them."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from pipeline.planning.settings import DEFAULT_PRESET
from services.cli.arguments import WrongArgument, add_knobs, settings_of
from services.cli.commands.options import add_executor
from services.cli.commands.running import executor_for, progress_bars, scan_path
from services.cli.exit_codes import OK

CODECS = ("jpeg", "webp", "png", "bc7")
PAGE_PX = (32, 512)
MOST_SECONDS, MOST_MAGNIFIED = 3600, 16


def add_pages(commands) -> None:
    """The verb `pages`."""
    pages = commands.add_parser(
        "pages", help="the photographs of a scan as a page file, for views that are larger than memory"
    )
    pages.add_argument("source", metavar="SCAN|WORK", help="a scan, or the folder that `compress --work` kept")
    pages.add_argument("--out", required=True, type=Path, metavar="FILE")
    pages.add_argument(
        "--page-size",
        type=int,
        default=128,
        metavar="PX",
        help="a side of a page: a multiple of 4 from 32 to 512; default: 128",
    )
    pages.add_argument(
        "--codec",
        choices=CODECS,
        default="jpeg",
        help="of each page; png loses nothing, bc7 is what a GPU takes; default: jpeg",
    )
    pages.add_argument("--quality", type=int, default=90, metavar="Q", help="of jpeg and webp, 1 to 100; default: 90")
    pages.add_argument("--overwrite", "-w", action="store_true", help="replace FILE")
    pages.add_argument("--work", metavar="DIR", help="keep the stages' outputs there, and use what is there already")
    pages.add_argument("--json", action="store_true", help="what was written as the last line of stdout")
    pages.set_defaults(preset=DEFAULT_PRESET)
    add_knobs(pages, ("sparse_model",))
    add_executor(pages)
    pages.set_defaults(command=_pages)


def _pages(options: argparse.Namespace) -> int:
    from services.processes.pages.page_file import PageForm, make_pages

    if options.page_size % 4 or not PAGE_PX[0] <= options.page_size <= PAGE_PX[1]:
        raise WrongArgument(
            f"--page-size {options.page_size}; allowed: a multiple of 4 from {PAGE_PX[0]} to {PAGE_PX[1]}"
        )
    if not 1 <= options.quality <= 100:
        raise WrongArgument(f"--quality {options.quality}; allowed: 1 to 100")
    source = scan_path(options.source)
    if options.out.exists() and not options.overwrite:
        raise WrongArgument(f"--out {options.out} exists; choose another, or say --overwrite")
    form = PageForm(options.codec, options.page_size, 4, options.quality)
    with executor_for(options) as executor:
        made = make_pages(
            source, options.out, form, executor, progress_bars(), reading=settings_of(options).reading,
            work=Path(options.work) if options.work else None,
        )  # fmt: skip
    if options.json:
        print(json.dumps(made))
        return OK
    print(
        f"{options.out}  {made['n_pages']:,} pages of {made['n_photographs']:,} photographs, {made['bytes']:,} bytes "
        f"({made['raw_bytes'] / made['bytes']:.1f} times smaller than their texels), {made['psnr_db']:.2f} dB"
    )
    return OK


def add_path(commands) -> None:
    """The verb `path record`."""
    path = commands.add_parser("path", help="paths for `fly`")
    verbs = path.add_subparsers(required=True, metavar="COMMAND")
    record = verbs.add_parser("record", help="a path from poses: one of the four of the paper, or a spline")
    record.add_argument("packed", metavar="PACKED")
    record.add_argument(
        "--through",
        default="photographs",
        metavar="WHAT",
        help="look_around, forward, backward, sideways; photographs (a spline through their poses); or a path file, whose poses "
        "a spline goes through; default: photographs",
    )
    record.add_argument("--seconds", type=float, default=4.0, help="of a spline; default: 4")
    record.add_argument("--out", required=True, type=Path, metavar="PATH.json")
    record.set_defaults(command=_record)


def _record(options: argparse.Namespace) -> int:
    from services.processes.pages.record import KINDS, record

    if not 0 < options.seconds <= MOST_SECONDS:
        raise WrongArgument(f"--seconds {options.seconds:g}; allowed: above 0, up to {MOST_SECONDS}")
    if options.through not in KINDS and not Path(options.through).is_file():
        raise WrongArgument(f"--through {options.through!r}; allowed: {', '.join(KINDS)}, or a path file")
    path = record(scan_path(options.packed), options.through, options.seconds, options.out)
    print(f"{options.out}  {len(path.poses):,} poses")
    return OK


def add_fly(commands) -> None:
    """The verb `fly`."""
    fly = commands.add_parser("fly", help="a recorded path, drawn; or which pages it would miss")
    fly.add_argument("packed", metavar="PACKED")
    fly.add_argument(
        "--table",
        action="store_true",
        help="page misses of the four paths of the paper, by prediction and policy, simulated",
    )
    fly.add_argument(
        "--magnified", type=int, default=4, metavar="N", help="with --table: photographs N times as wide; default: 4"
    )
    fly.add_argument("--json", action="store_true", help="what was measured as the last line of stdout")
    fly.set_defaults(command=_fly)


def _fly(options: argparse.Namespace) -> int:
    from services.processes.pages.table import as_text, table_of

    if not 1 <= options.magnified <= MOST_MAGNIFIED:
        raise WrongArgument(f"--magnified {options.magnified}; allowed: 1 to {MOST_MAGNIFIED}")
    found = table_of(
        scan_path(options.packed), options.magnified, on_path=lambda name: print(f"path {name}", file=sys.stderr)
    )
    print(json.dumps(found) if options.json else as_text(found))
    return OK
