"""The verbs `pages`, `path` and `fly`: photographs in pages, and recorded paths that want some of them."""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path

from pipeline.planning.settings import DEFAULT_PRESET
from services.cli.arguments import add_knobs, settings_of
from services.cli.commands.options import add_executor, count, size
from services.cli.commands.running import executor_for, progress_bars, refuse_to_overwrite, scan_path
from services.cli.exit_codes import OK
from services.cli.parser import WrongArgument

CODECS = ("jpeg", "webp", "png", "bc7")
PAGE_PX = (32, 512)
PREDICTIONS = {"none": "nothing", "bias": "bias", "frustum": "frustum", "combined": "combined"}
MOST_SECONDS, MOST_MAGNIFIED = 3600, 16


def add_pages(commands) -> None:
    """The verb `pages`."""
    pages = commands.add_parser("pages")
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
    from pipeline.stages.pages.coded import PageForm
    from services.processes.pages.page_file import make_pages

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
    record = commands.add_parser("path")
    record.add_argument("verb", choices=("record",), help="what is done: a path is recorded")
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
    fly = commands.add_parser("fly")
    fly.add_argument("packed", metavar="PACKED")
    fly.add_argument(
        "--table",
        action="store_true",
        help="page misses of the four paths of the paper, by prediction and policy, simulated",
    )
    fly.add_argument(
        "--magnified", type=int, default=4, metavar="N", help="with --table: photographs N times as wide; default: 4"
    )
    fly.add_argument(
        "--cold-start",
        action="store_true",
        help="with --table: besides of a viewer who comes in at once, with nothing loaded",
    )
    fly.add_argument("--path", type=Path, metavar="PATH.json", help="what `path record` wrote")
    fly.add_argument("--pages", type=Path, metavar="F", help="default: the packed file's name with .pages, beside it")
    fly.add_argument("--out", type=Path, metavar="DIR", help="frames as PNG, a video where ffmpeg is found, fly.json")
    fly.add_argument("--overwrite", "-w", action="store_true", help="replace what is in DIR")
    fly.add_argument(
        "--size", type=size, default=(720, 780), metavar="WxH", help="of a frame, 90 degrees wide; default: 720x780"
    )
    fly.add_argument("--pool-mib", type=count, default=256, metavar="N", help="that resident pages take; default: 256")
    fly.add_argument(
        "--bandwidth", type=_bandwidth, default=200e6, metavar="200MB/s", help="of pages as texels; default: 200MB/s"
    )
    fly.add_argument("--prediction", choices=tuple(PREDICTIONS), default="combined", help="default: combined")
    fly.add_argument(
        "--policy", choices=("default", "paper"), default="default", help="of loading and evicting; paper: as published"
    )
    fly.add_argument(
        "--every",
        type=count,
        default=1,
        metavar="N",
        help="draw every N-th pose, as if one walked N times as fast; default: all",
    )
    fly.add_argument("--json", action="store_true", help="what was measured as the last line of stdout")
    fly.set_defaults(command=_fly)


def _bandwidth(text: str) -> float:
    """Bytes a second of `200MB/s`, `1.5GB/s` or `500kB/s`."""
    found = re.fullmatch(r"([0-9]*\.?[0-9]+)([kMG])B(/s)?", text.strip())
    if found is None or float(found[1]) <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is no bandwidth; allowed: above 0, as 200MB/s, 1.5GB/s, 500kB/s")
    return float(found[1]) * {"k": 1e3, "M": 1e6, "G": 1e9}[found[2]]


def _fly(options: argparse.Namespace) -> int:
    packed = scan_path(options.packed)
    if options.table:
        return _table(packed, options)
    from services.processes.pages.fly import FlightOptions, fly
    from storage.packed.seal import check_seal

    if options.path is None or options.out is None:
        raise WrongArgument("fly draws a --path into --out; or say --table")
    check_seal(packed)  # before what lies beside it
    pages = options.pages or packed.with_suffix(".pages")
    for needed in (options.path, pages):
        if not needed.is_file():
            raise FileNotFoundError(f"{needed}: no such file")
    refuse_to_overwrite(options.out, options.overwrite)
    prediction = PREDICTIONS[options.prediction]
    found = fly(
        packed, pages, options.path, options.out,
        FlightOptions(options.size, options.pool_mib << 20, options.bandwidth, prediction, options.policy, options.every),
    )  # fmt: skip
    for warning in found["warnings"]:
        print(f"warning: {warning}", file=sys.stderr)
    if options.json:
        print(json.dumps(found))
        return OK
    passes = ", ".join(f"{name} {spread['median']:.1f}" for name, spread in found["pass_ms"].items())
    print(f"{options.out}  {len(found['frames']):,} frames, median {found['frame_ms']['median']:.1f} ms ({passes})")
    print(
        f"missed {100 * found['missed_pixels']:.3f} % of pixels, {found['missed_pages']:.1f} of {found['wanted_pages']:.1f} pages a "
        f"frame; loaded {found['loaded']:,}, evicted {found['evicted']:,}, late {found['late']:,}"
    )
    return OK


def _table(packed: Path, options: argparse.Namespace) -> int:
    from services.processes.pages.table import as_text, table_of

    if not 1 <= options.magnified <= MOST_MAGNIFIED:
        raise WrongArgument(f"--magnified {options.magnified}; allowed: 1 to {MOST_MAGNIFIED}")
    found = table_of(
        packed, options.magnified, on_path=lambda name: print(f"path {name}", file=sys.stderr), cold=options.cold_start
    )
    print(json.dumps(found) if options.json else as_text(found))
    return OK
