"""The verb `pages`: photographs as a page file."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from pipeline.planning.settings import DEFAULT_PRESET
from services.cli.arguments import WrongArgument, add_knobs, settings_of
from services.cli.commands.options import add_executor
from services.cli.commands.running import executor_for, progress_bars, scan_path
from services.cli.exit_codes import OK

CODECS = ("jpeg", "webp", "png", "bc7")
PAGE_PX = (32, 512)


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
