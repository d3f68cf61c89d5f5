"""The commands that make a report: `compress`, `report` and `demo`; and the gate that they may have to pass."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from pipeline.planning.settings import Settings
from services.cli.arguments import add_preset, add_settings, settings_of, target_in_words
from services.cli.commands.looks import add_edited_maps, settings_with_maps
from services.cli.commands.options import add_output, add_running, add_strict
from services.cli.commands.running import (
    executor_for,
    look_at_opengl,
    look_first,
    made_folder,
    program,
    progress_bars,
    refuse_to_overwrite,
    scan_path,
)
from services.cli.exit_codes import GATE_MISSED, OK
from services.cli.wording import as_options

COMPRESS = "services.processes.compress"  # takes half a second to import, while workers start


def add_compress(commands) -> None:
    """The verb `compress`."""
    compress = commands.add_parser("compress")
    compress.add_argument(
        "scan",
        metavar="SCAN",
        help="COLMAP or nerfstudio workspace (folder or .zip), .ply, .las, .laz, .e57, .ptx, .pts, .xyz, .pcd; a volume, see iso",
    )
    add_output(compress)
    add_settings(compress)
    add_edited_maps(compress)
    compress.add_argument(
        "--pages", action="store_true", help="photographs, or maps of stations, in pages beside it: --effect pages=on"
    )
    add_strict(compress)
    add_running(compress)
    compress.set_defaults(command=_compress)


def _compress(options: argparse.Namespace) -> int:
    settings = settings_with_pages(settings_with_maps(options), options.pages)
    scan, out = scan_path(options.scan), Path(options.out)
    refuse_to_overwrite(out, options.overwrite)
    look_first(scan, not options.no_render, settings)
    with executor_for(options, lambda: import_module(COMPRESS)) as executor:
        report = import_module(COMPRESS).compress(
            scan,
            out,
            settings,
            executor,
            progress_bars(),
            render=not options.no_render,
            work=Path(options.work) if options.work else None,
            strict=options.strict,
            edited_maps=Path(options.maps) if options.maps else None,
        )
    textured = report["quality"]["texture_psnr_db"] is not None
    if not textured and (words := target_in_words(options, textured)):
        print(f"warning          {words}", file=sys.stderr)
    return _show_report(report, out, options)


def settings_with_pages(settings: Settings, pages: bool) -> Settings:
    """The settings, with the effect `pages` asked for where `--pages` is said."""
    from pipeline.effects.plan.request import canonical_request

    return replace(settings, effects=canonical_request([settings.effects, "pages=on"])) if pages else settings


def add_report(commands) -> None:
    """The verb `report`."""
    report = commands.add_parser("report")
    report.add_argument("packed", metavar="PACKED")
    report.add_argument("--scan", required=True, metavar="SCAN")
    report.add_argument("--out", required=True, metavar="DIR")
    add_running(report)
    report.set_defaults(command=_report)


def _report(options: argparse.Namespace) -> int:
    from services.processes.inspect import inspect_packed
    from services.processes.report import report

    out, packed, scan = Path(options.out), scan_path(options.packed), scan_path(options.scan)
    inspect_packed(packed)
    look_at_opengl(not options.no_render)
    with executor_for(options) as executor:
        made = report(
            packed,
            scan,
            out,
            executor,
            progress_bars(),
            render=not options.no_render,
        )
    return _show_report(made, out, options)


def add_demo(commands) -> None:
    """The verb `demo`."""
    demo = commands.add_parser("demo")
    demo.add_argument(
        "--scan",
        choices=("motorcycle", "points", "volume"),
        default="motorcycle",
        help="a real stereo pair; a made-up laser scan of points alone; a made-up volume",
    )
    demo.add_argument("--out", metavar="DIR", help="default: demo-output, of the others demo-output-points, -volume")
    add_preset(demo)
    demo.add_argument("--overwrite", "-w", action="store_true", help="make it anew, and replace what is in DIR")
    demo.add_argument(
        "--refresh", action="store_true", help="replace what is in DIR where another program or other settings made it"
    )
    add_running(demo)
    demo.set_defaults(command=_demo)


def _demo(options: argparse.Namespace) -> int:
    import tempfile

    from services.processes.compress import compress
    from services.processes.demo.made import known, remember
    from services.processes.demo.scans import SCANS

    demo, draws = SCANS[options.scan], not options.no_render
    settings, out = replace(settings_of(options), iso=demo.iso), Path(options.out or demo.out)
    if not options.overwrite and (report := known(out, settings, options.scan, draws)) is not None:
        print(f"made before by the same program, and shown again; made anew with --overwrite: {out}", file=sys.stderr)
        return _show_report(report, out, options, out / demo.scan)
    refuse_to_overwrite(out, options.overwrite or options.refresh)
    with tempfile.TemporaryDirectory(dir=made_folder(out.absolute().parent)) as folder:
        scan = demo.write(Path(folder))
        look_first(scan, draws, settings)
        with executor_for(options) as executor:
            report = compress(scan, out, settings, executor, progress_bars(), render=draws)
        import shutil

        shutil.move(scan, out / demo.scan)
    remember(out, settings, options.scan, draws)
    return _show_report(report, out, options, out / demo.scan)


def _show_report(report: dict, out: Path, options: argparse.Namespace, scan: Path | None = None) -> int:
    missed = _missed_gate(report, options)
    if options.json:
        print(json.dumps({**report, "out": str(out), "gate_missed": missed}))
    else:
        if scan is not None:
            print(f"scan             {scan}")
        print(_summary(report, out))
    if missed:
        print(f"splatpress: quality gate missed: {missed}", file=sys.stderr)
        return GATE_MISSED
    return OK


def _missed_gate(report: dict, options: argparse.Namespace) -> str | None:
    wanted, got = options.require_psnr_db, report["quality"]["texture_psnr_db"]
    if wanted is None:
        return None
    if got is None:
        return f"no texture PSNR is measured without photographs, asked for {wanted:g}"
    return None if got >= wanted else f"texture PSNR is {got:.2f} dB, asked for {wanted:g}"


def _summary(report: dict, out: Path) -> str:
    sizes, quality = report["sizes"], report["quality"]
    lines = [
        f"splats           {report['splats']:,}",
        f"size             {sizes['own_bytes_per_splat']:.2f} bytes a splat on the GPU, file {sizes['file_bytes']:,} bytes",
        *(
            [
                f"atoms            ship with the program: {shipped:,} bytes beside on the GPU, for any scan; none in the file"
            ]
            if (shipped := sizes["shipped_bytes"])
            else []
        ),
    ]
    if quality["texture_psnr_db"] is not None:
        from renderer.report.report_words import decibels

        texture, visible, resampling = (
            decibels(quality[f"{what}_psnr_db"]) for what in ("texture", "visible", "resampling")
        )
        lines.append(f"texture PSNR     {texture}, visible {visible}, resampling {resampling}")
    if sizes["own_factor_total"] is not None:
        with_atoms = f"; with the atoms beside {sizes['compression_factor_total']:.1f} times in all" if shipped else ""
        lines.append(
            f"compression      on the GPU {sizes['own_factor_total']:.1f} times in all, "
            f"{sizes['own_factor_texture']:.1f} times the textures{with_atoms}"
        )
    lines += [f"warning          {as_options(w)}" for w in report.get("warnings", [])]
    if pages := report.get("pages"):
        lossy = "" if pages["psnr_db"] is None else f", {pages['psnr_db']:.2f} dB"
        where = ", ".join(str(path) for path in out.glob("*.pages"))
        lines.append(f"pages            {pages['n_pages']:,} in {pages['bytes']:,} bytes{lossy}, {where}")
    lines.append(f"report           {out / 'report.html'}")
    if quality["views"]:
        lines.append(f"previews         {out / 'previews'}")
    for packed in out.glob("*.splatpress"):  # none where one that lies elsewhere was measured
        name = shlex.quote(str(packed))
        lines += [f"packed           {packed}", f"look at it       {program()} view {name}"]
    return "\n".join(lines)
