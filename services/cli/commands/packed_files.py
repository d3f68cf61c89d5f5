"""The command line's verbs `export` and `view`: a packed file as what others open, and in the browser."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from pipeline.exports.formats import AUTO, FIT_STEPS, FORMATS, GAUSSIANS, POINTS, SAMPLES, TILES
from services.cli.exit_codes import OK
from services.cli.parser import WrongArgument

MOST_STEPS = 100


def add_export(commands) -> None:
    """The verb `export`."""
    export = commands.add_parser("export")
    export.add_argument("packed", metavar="PACKED")
    export.add_argument(
        "--to",
        required=True,
        choices=FORMATS,
        metavar="FORMAT",
        help="; ".join(f"{name}: {known.kind}, {known.about}" for name, known in FORMATS.items()),
    )
    export.add_argument(
        "--out", type=Path, metavar="FILE", help="default: the packed file's name with the format's ending, beside it"
    )
    kinds = ", ".join(n for n, known in FORMATS.items() if known.kind in (POINTS, GAUSSIANS, TILES))
    many = export.add_mutually_exclusive_group()
    many.add_argument(
        "--samples",
        choices=SAMPLES,
        default=AUTO,
        help=f"points or Gaussians a splat ({kinds}); {AUTO}: one point; or four Gaussians where its texture has "
        "contrast and one behind, about 3.5 times the bytes of 1",
    )
    many.add_argument("--textured", action="store_true", help="the same as --samples 12")
    export.add_argument(
        "--fit",
        type=_steps,
        default=FIT_STEPS,
        metavar="STEPS",
        help=f"that colours of Gaussians are fitted by to pictures of the file, about 40 s a million Gaussians on two "
        f"cores; 0 for none, default: {FIT_STEPS}",
    )
    export.add_argument("--overwrite", "-w", action="store_true", help="replace FILE")
    export.add_argument("--json", action="store_true", help="what was written and lost as the last line of stdout")
    export.set_defaults(command=_export)


def _steps(text: str) -> int:
    if not text.isdecimal() or int(text) > MOST_STEPS:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of steps from 0 to {MOST_STEPS}")
    return int(text)


def _export(options: argparse.Namespace) -> int:
    from services.processes.export import export

    packed = Path(options.packed)
    if not packed.exists():
        raise FileNotFoundError(f"{packed}: no such file or folder")
    out = options.out or packed.with_suffix(FORMATS[options.to].suffix)
    if out.exists() and not options.overwrite:
        raise WrongArgument(f"--out {out} exists; choose another, or say --overwrite")
    samples = "12" if options.textured else options.samples
    made = export(packed, options.to, out, samples, options.fit)
    if options.json:
        print(json.dumps({**asdict(made), "path": str(made.path)}))
    else:
        print(f"{made.path}  {made.n_elements:,} {FORMATS[options.to].kind}, {made.n_bytes:,} bytes")
        for text in made.lost:
            print(f"loses {text}")
    return OK


def add_view(commands) -> None:
    """The verb `view`."""
    view = commands.add_parser("view")
    view.add_argument("packed", metavar="PACKED")
    view.add_argument("--port", type=int, default=0, help="on 127.0.0.1; default: one that is free")
    view.add_argument("--no-open", action="store_true", help="only print the page's address")
    view.set_defaults(command=_view)


def _view(options: argparse.Namespace) -> int:
    import webbrowser

    import uvicorn

    from services.processes.export import viewed
    from services.web.viewing import viewer_app
    from storage.packed.packed import PackedFile

    packed = Path(options.packed)
    if not packed.exists():
        raise FileNotFoundError(f"{packed}: no such file or folder")
    with PackedFile(packed) as opened:  # what is damaged is said here
        is_archive = opened.is_archive
    import socket

    with viewed(packed, is_archive) as shown, socket.create_server(("127.0.0.1", options.port)) as listener:
        url = f"http://127.0.0.1:{listener.getsockname()[1]}/"
        print(url, flush=True)
        print("open that address in a browser on this machine; Ctrl-C ends it", file=sys.stderr, flush=True)
        if not options.no_open:
            webbrowser.open(url)
        uvicorn.Server(uvicorn.Config(viewer_app(shown), log_level="warning")).run(sockets=[listener])
    return OK
