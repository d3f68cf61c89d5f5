"""The command line: splatpress compress | inspect | check | render | report | demo, and the service's verbs.

Exit codes: 0 ok, 1 arguments, 2 I/O or resources, 3 invalid input, 4 a mistake of ours, 5 unsupported, 7 a quality
gate missed.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shlex
import shutil
import sys
import traceback
import warnings
from pathlib import Path

from pipeline.planning.settings import DEFAULT_PRESET
from pipeline.readers.attributes.options import ReadOptions
from services.cli.arguments import WrongArgument, add_knobs, add_preset, add_settings, add_view_knobs, settings_of
from services.cli.looks import add_edited_maps, add_iso, add_map, settings_with_maps
from services.cli.packed_files import add_export, add_view
from services.cli.parser import ARGUMENTS, Parser
from services.cli.service import add_service_verbs
from storage.errors import InvalidScan, ResourceExhausted, SplatpressError
from storage.version import VERSION

OK, INPUT_OUTPUT, INVALID_INPUT, INTERNAL, GATE_MISSED, INTERRUPTED = 0, 2, 3, 4, 7, 130


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files are bytes, and may be no text
    options = _parser().parse_args(arguments)
    warnings.filterwarnings("ignore", module="zarr")
    try:
        return options.command(options)
    except SplatpressError as error:
        print(f"splatpress: {error.kind} error: {error}", file=sys.stderr)
        _print_notes(error)
        return error.exit_code
    except WrongArgument as error:
        print(f"splatpress: {error}", file=sys.stderr)
        return ARGUMENTS
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except OSError as error:
        print(f"splatpress: {error}", file=sys.stderr)
        _print_notes(error)
        return INPUT_OUTPUT
    except MemoryError:
        print("splatpress: resource error: memory ran out; allowed: as much as the machine has", file=sys.stderr)
        return INPUT_OUTPUT
    except KeyboardInterrupt:
        print("splatpress: interrupted", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if type(error).__module__.startswith("httpx"):
            print(f"splatpress: no answer from {_asked(error)}: {error}", file=sys.stderr)
            return INPUT_OUTPUT
        if type(error).__module__.startswith("sqlalchemy"):
            from services.problems import is_of_database

            if is_of_database(error):
                print(
                    f"splatpress: resource error: the database does not answer: {getattr(error, 'orig', error)}",
                    file=sys.stderr,
                )
                return INPUT_OUTPUT
        # Whatever else comes here is ours to mend, and must not look like wrong arguments.
        traceback.print_exc()
        print("splatpress: internal error: please report the lines above", file=sys.stderr)
        return INTERNAL


def _print_notes(error: Exception) -> None:
    """What an error says besides, as that a packed file was kept."""
    for note in getattr(error, "__notes__", ()):
        print(f"splatpress: {note}", file=sys.stderr)


def _asked(error: Exception) -> str:
    """The service that an error of httpx is about."""
    request = getattr(error, "_request", None)
    return "the service" if request is None else str(request.url.copy_with(path="/", query=None))


# --- commands: heavy imports stand inside, so that --help and inspect answer at once ----------------------------------


def _compress(options: argparse.Namespace) -> int:
    from services.processes.compress import compress

    settings = settings_with_maps(options)
    scan, out = _scan_path(options.scan), Path(options.out)
    _refuse_to_overwrite(out, options.overwrite)
    _look_first(scan, draws=not options.no_render, reading=settings.reading)
    with _executor(options) as executor:
        report = compress(
            scan,
            out,
            settings,
            executor,
            _progress(),
            render=not options.no_render,
            work=Path(options.work) if options.work else None,
            strict=options.strict,
            edited_maps=Path(options.maps) if options.maps else None,
        )
    return _show_report(report, out, options)


def _inspect(options: argparse.Namespace) -> int:
    from services.processes.inspect import inspect

    found = inspect(_scan_path(options.path), settings_of(options).reading)
    print(json.dumps(found) if options.json else _as_lines(found))
    return OK


def _check(options: argparse.Namespace) -> int:
    from services.processes.inspect import check

    found = check(_scan_path(options.path), settings_of(options).reading, options.strict)
    if options.json:
        print(json.dumps(found))
    else:
        for finding in found["findings"]:
            print(f"{finding['severity']}: {finding['text']}")
        print("ok: compress takes it" if found["ok"] else "not ok: see above")
    return OK if found["ok"] else INVALID_INPUT


def _effects(options: argparse.Namespace) -> int:
    from services.processes.effects import effects_of, worth_of_effects

    settings, scan = settings_of(options), _scan_path(options.scan)
    work = Path(options.work) if options.work else None
    if options.measure:
        with _executor(options) as executor:
            found = worth_of_effects(
                scan, settings, executor, _progress(), work, Path(options.out) if options.out else None
            )
        print(json.dumps(found) if options.json else _variant_lines(found["variants"]))
        return OK
    with _executor(options) as executor:
        rows = effects_of(scan, settings, executor, _progress(), work)
    if options.json:
        print(json.dumps(rows))
    else:
        for row in rows:
            print(
                f"{row['effect']:<16} {'on ' if row['enabled'] else 'off'}  {_percent(row['share']):>7}  {row['reason']}"
            )
    return OK


def _variant_lines(variants: list[dict]) -> str:
    lines = [
        f"{'variant':<24} {'frame ms':>9} {'of plan':>8} {'GPU bytes':>12} {'file bytes':>12} {'photos dB':>9} {'plan dB':>8}"
    ]
    for v in variants:
        decibels = [f"{v[k]:.2f}" if v[k] is not None else "-" for k in ("psnr_vs_photos_db", "psnr_vs_first_db")]
        lines.append(
            f"{v['variant']:<24} {1000 * v['frame_s']:>9.1f} {v['frame_ratio']:>8.3f} {v['gpu_bytes']:>12,} {v['file_bytes']:>12,} "
            f"{decibels[0]:>9} {decibels[1]:>8}"
        )
    return "\n".join(lines)


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f} %"


def _plan(options: argparse.Namespace) -> int:
    from services.processes.plan import as_text, plan, speed_of_this_machine

    speed = 1.0 if options.as_measured else speed_of_this_machine()
    found = plan(options.splats, options.workers, settings_of(options), options.photographs, options.megapixels, speed)
    print(json.dumps(found) if options.json else as_text(found))
    return OK


def _render(options: argparse.Namespace) -> int:
    from renderer.effects.relighting import lamp
    from services.processes.render import render_views

    paths = render_views(
        _scan_path(options.packed),
        Path(options.out),
        camera=options.camera,
        n_orbit=options.turntable or options.orbit,
        animated=bool(options.turntable),
        background=options.background,
        size=options.size,
        max_atoms=options.atoms,
        precision=options.precision,
        light=lamp(*options.light) if options.light else None,
    )
    for path in paths:
        print(path)
    return OK


def _coverage(options: argparse.Namespace) -> int:
    from services.processes.render import coverage_of

    found = coverage_of(_scan_path(options.packed))
    if options.json:
        print(json.dumps(found))
        return OK
    print(
        f"{'view':<12}{'holes':>9}{'behind':>9}{'before':>9}{'overdraw':>10}   of the surface, against discs of exact sizes"
    )
    for row in found["surface"]:
        shares = "".join(f"{100 * row[k]:8.2f}%" for k in ("holes", "see_through", "before"))
        print(f"{row['camera']:<12}{shares}{row['overdraw']:10.2f}")
    print(f"{'view':<12}{'covered':>9}{'holes':>9}   of the picture; inside the outline, closed by 9x9 px")
    for row in found["outline"]:
        print(f"{row['camera']:<12}{100 * row['coverage']:8.2f}%{100 * row['holes']:8.2f}%")
    return OK


def _report(options: argparse.Namespace) -> int:
    from services.processes.report import report

    out = Path(options.out)
    with _executor(options) as executor:
        made = report(
            _scan_path(options.packed),
            _scan_path(options.scan),
            out,
            executor,
            _progress(),
            render=not options.no_render,
        )
    return _show_report(made, out, options)


def _evaluate(options: argparse.Namespace) -> int:
    from services.processes.evaluate import ROWS, evaluate

    settings, out = settings_of(options), Path(options.out)
    rows = options.rows.split(",") if options.rows else ROWS
    if unknown := [row for row in rows if row not in ROWS]:
        raise WrongArgument(f"--rows has {', '.join(map(repr, unknown))}; allowed: {', '.join(ROWS)}")
    scan = _scan_path(options.scan)
    _refuse_to_overwrite(out, options.overwrite)
    _needs_photographs(scan, settings.reading, "there is no texture to evaluate")
    with _executor(options) as executor:
        made = evaluate(
            scan,
            out,
            settings,
            executor,
            _progress(),
            rows=rows,
            hold_out=options.hold_out,
            render=not options.no_render,
            work=Path(options.work) if options.work else None,
        )
    if options.json:
        print(json.dumps({**made, "out": str(out)}))
    else:
        print(_table_1(made["rows"]))
        print(f"page  {out / 'evaluate.html'}")
    for failure in made["failed"]:
        print(
            f"splatpress: {failure['class']} error: {failure['name']}: {failure['error']}; all else is there",
            file=sys.stderr,
        )
    codes = {"data": INVALID_INPUT, "resource": INPUT_OUTPUT, "internal": INTERNAL}
    return codes[made["failed"][0]["class"]] if made["failed"] else OK


def _estimate(options: argparse.Namespace) -> int:
    from services.processes.estimate import estimate

    settings, scan = settings_of(options), _scan_path(options.scan)
    work = Path(options.work) if options.work else None
    if work:
        work.mkdir(parents=True, exist_ok=True)
    with _executor(options) as executor:
        found = estimate(scan, settings, executor, _progress(), work)
    print(json.dumps(found) if options.json else _estimate_lines(found))
    return OK


def _estimate_lines(found: dict) -> str:
    from renderer.report.report_words import ESTIMATE

    lines = [
        f"{title:<24} {say(figure['value']):>14}   {say(figure['low'])} to {say(figure['high'])}"
        for name, title, say in ESTIMATE
        if (figure := found[name])
    ]
    lines.append(f"{'Bytes a splat':<24} {found['bytes_per_splat']:>14.2f}")
    return "\n".join(
        [
            *lines,
            f"from {found['sample']['n_splats']:,} of {found['splats']:,} splats; up to the packed file, with {found['n_workers']} workers",
        ]
    )


def _tradeoff(options: argparse.Namespace) -> int:
    from services.processes.tradeoff import parsed_budget, parsed_knobs, tradeoff

    settings, out = settings_of(options), Path(options.out)
    try:
        budget_s, knobs = parsed_budget(options.budget), parsed_knobs(options.knob) if options.knob else None
    except ValueError as error:
        raise WrongArgument(str(error)) from error
    scan = _scan_path(options.scan)
    _refuse_to_overwrite(out, options.overwrite)
    _needs_photographs(scan, settings.reading, "without, no knob trades accuracy")
    with _executor(options) as executor:
        made = tradeoff(
            scan,
            out,
            settings,
            executor,
            _progress(),
            knobs=knobs,
            budget_s=budget_s,
            render=not options.no_render,
            work=Path(options.work) if options.work else None,
        )
    if options.json:
        print(json.dumps({**made, "out": str(out)}))
    else:
        print(
            "\n".join(
                f"{p['key']:<28}{p['texture_psnr_db']:8.2f} dB{p['bytes_per_splat']:9.2f} B a splat{p['seconds']:9.1f} s"
                for p in made["points"]
            )
        )
        print(f"page  {out / 'tradeoff.html'}")
    return OK


def _table_1(rows: list[dict]) -> str:
    lines = [f"{'textures':<28}{'texture bytes':>15}{'B a splat':>11}{'PSNR dB':>9}{'visible':>9}{'seconds':>9}"]
    for row in rows:
        psnr = [
            f"{row[k]:9.2f}" if row[k] is not None else f"{'exact':>9}" for k in ("texture_psnr_db", "visible_psnr_db")
        ]
        name = f"{row['name']}, {row['coder']}" if row["kind"] == "ours" else row["name"]
        lines.append(
            f"{name:<28}{row['texture_bytes']:>15,}{row['bytes_per_splat']:>11.2f}{psnr[0]}{psnr[1]}{row['seconds']:>9.1f}"
        )
    return "\n".join(lines)


def _demo(options: argparse.Namespace) -> int:
    import tempfile

    from services.processes.compress import compress
    from services.processes.demo import write_motorcycle

    settings, out = settings_of(options), Path(options.out)
    _refuse_to_overwrite(out, options.overwrite)
    with tempfile.TemporaryDirectory(dir=_made(out.absolute().parent)) as folder:
        scan = write_motorcycle(Path(folder) / "motorcycle")
        _look_first(scan, draws=not options.no_render, reading=settings.reading)
        with _executor(options) as executor:
            report = compress(scan, out, settings, executor, _progress(), render=not options.no_render)
        shutil.move(scan, out / "scan")
    return _show_report(report, out, options)


def _executor(options: argparse.Namespace):
    from pipeline.execution.executors import DaskExecutor, SerialExecutor

    if options.executor == "serial":
        return SerialExecutor()
    return DaskExecutor(options.workers, options.scheduler)


def _progress():
    from services.cli.progress import ProgressBars

    return ProgressBars()


def _scan_path(text: str) -> Path:
    path = Path(text)
    if not path.exists():
        raise FileNotFoundError(f"{text}: no such file or folder")
    return path


def _look_first(scan: Path, draws: bool, reading: ReadOptions) -> None:
    """What takes a second is looked at before workers start: the scan's header, and OpenGL where pictures are wanted."""
    from renderer.splats.context import gl_context
    from services.processes.inspect import inspect

    inspect(scan, reading)
    if draws:
        try:
            gl_context().release()
        except ResourceExhausted as error:
            raise ResourceExhausted(
                error.where, error.found, error.allowed, f"{error.hint}; or go without pictures: --no-render"
            ) from error


def _needs_photographs(scan: Path, reading: ReadOptions, why: str) -> None:
    """Told by the header, before workers start."""
    from services.processes.inspect import inspect

    if not inspect(scan, reading).get("cameras", {}).get("count"):
        raise InvalidScan(str(scan), "no photographs", f"a scan with photographs: {why}")


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _refuse_to_overwrite(out: Path, overwrite: bool) -> None:
    if out.exists() and not overwrite and (not out.is_dir() or any(out.iterdir())):
        raise WrongArgument(f"--out {out} exists and is not empty; choose another, or say --overwrite")


def _show_report(report: dict, out: Path, options: argparse.Namespace) -> int:
    missed = _missed_gate(report, options)
    if options.json:
        print(json.dumps({**report, "out": str(out), "gate_missed": missed}))
    else:
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
        f"size             {sizes['bytes_per_splat']:.2f} bytes a splat on the GPU, file {sizes['file_bytes']:,} bytes",
    ]
    if quality["texture_psnr_db"] is not None:
        from renderer.report.report_words import decibels

        texture, visible, resampling = (
            decibels(quality[f"{what}_psnr_db"]) for what in ("texture", "visible", "resampling")
        )
        lines.append(f"texture PSNR     {texture}, visible {visible}, resampling {resampling}")
    if sizes["compression_factor_total"] is not None:
        lines.append(
            f"compression      {sizes['compression_factor_total']:.1f} times in all, "
            f"{sizes['compression_factor_texture']:.1f} times the textures"
        )
    lines += [f"warning          {w}" for w in report.get("warnings", [])]
    lines.append(f"report           {out / 'report.html'}")
    if quality["views"]:
        lines.append(f"previews         {out / 'previews'}")
    for packed in out.glob("*.splatpress"):  # none where one that lies elsewhere was measured
        lines += [f"packed           {packed}", f"look at it       splatpress view {shlex.quote(str(packed))}"]
    return "\n".join(lines)


def _as_lines(found: dict, indent: str = "") -> str:
    lines = []
    for key, value in found.items():
        if isinstance(value, dict):
            lines += [f"{indent}{key}:", _as_lines(value, indent + "  ")]
        elif isinstance(value, list) and value and all(isinstance(v, str) for v in value):
            lines += [f"{indent}{key}:"] + [f"{indent}  {v}" for v in value]
        else:
            lines.append(f"{indent}{key}: {value}")
    return "\n".join(lines)


# --- arguments -------------------------------------------------------------------------------------------------------


def _count(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 on")
    return int(text)


def _large_count(text: str) -> int:
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 1 <= number <= 1e12:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of splats from 1 to 1e12")
    return int(number)


def _color(text: str) -> tuple[int, int, int]:
    digits = text.removeprefix("#")
    try:
        if len(digits) != 6:
            raise ValueError
        red, green, blue = bytes.fromhex(digits)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no colour; allowed: #RRGGBB, as #ffffff") from None
    return red, green, blue


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, as 1280x720") from None
    if not (1 <= width <= 16384 and 1 <= height <= 16384):
        raise argparse.ArgumentTypeError(f"{text} is out of range; allowed: 1x1 to 16384x16384")
    return width, height


def _direction(text: str) -> tuple[float, float, float]:
    try:
        right, up, towards = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not RIGHT,UP,TOWARDS, as 1,1,1") from None
    if not 0 < right * right + up * up + towards * towards < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is no direction; allowed: three finite numbers, one of them not 0")
    return right, up, towards


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="splatpress", description="Turns textured scans into small packed files that a GPU renders.")
    parser.add_argument("--version", action="version", version=f"splatpress {VERSION}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=Parser)
    _add_compress(commands)
    inspect = commands.add_parser("inspect", help="what a scan or a packed file is, and what is wrong with it")
    inspect.add_argument("path", metavar="SCAN-or-PACKED")
    inspect.add_argument("--json", action="store_true")
    _add_reading(inspect)
    inspect.set_defaults(command=_inspect)
    check = commands.add_parser("check", help="what is wrong with a scan, from one pass over its points; exit 0 or 3")
    check.add_argument("path", metavar="SCAN")
    check.add_argument("--json", action="store_true")
    _add_reading(check)
    _add_strict(check)
    check.set_defaults(command=_check)
    _add_effects(commands)
    _add_plan(commands)
    render = commands.add_parser("render", help="pictures of a packed file")
    render.add_argument("packed", metavar="PACKED")
    view = render.add_mutually_exclusive_group(required=True)
    view.add_argument("--camera", metavar="NAME", help="one of the scan's cameras")
    view.add_argument("--orbit", metavar="N", type=_count, help="N pictures around the scan")
    view.add_argument(
        "--turntable", metavar="N", type=_count, help="N pictures around the scan, and turntable.webp of them"
    )
    render.add_argument(
        "--background", type=_color, metavar="#RRGGBB", help="opaque pictures on that colour; default: transparent"
    )
    render.add_argument("--size", type=_size, metavar="WxH", help="default: the camera's own, or 1280x720")
    render.add_argument(
        "--light",
        type=_direction,
        metavar="RIGHT,UP,TOWARDS",
        help="a distant lamp that way from the viewer, as 1,1,1; default: as photographed",
    )
    add_view_knobs(render)
    render.add_argument("--out", required=True, metavar="DIR")
    render.set_defaults(command=_render)
    coverage = commands.add_parser("coverage", help="holes and overdraw of a packed file's splats, view by view")
    coverage.add_argument("packed", metavar="PACKED")
    coverage.add_argument("--json", action="store_true", help="what was measured as the last line of stdout")
    coverage.set_defaults(command=_coverage)
    report = commands.add_parser("report", help="measure a packed file against its scan")
    report.add_argument("packed", metavar="PACKED")
    report.add_argument("--scan", required=True, metavar="SCAN")
    report.add_argument("--out", required=True, metavar="DIR")
    _add_running(report)
    report.set_defaults(command=_report)
    demo = commands.add_parser("demo", help="compress a real stereo pair")
    demo.add_argument("--out", default="demo-output", metavar="DIR")
    add_preset(demo)
    demo.add_argument("--overwrite", "-w", action="store_true", help="replace what is in DIR")
    _add_running(demo)
    demo.set_defaults(command=_demo)
    _add_evaluate(commands)
    _add_estimate(commands)
    _add_tradeoff(commands)
    add_view(commands)
    add_export(commands)
    add_iso(commands, _add_executor)
    add_map(commands, _add_executor, _add_output)
    add_service_verbs(commands)
    return parser


def _add_effects(commands) -> None:
    effects = commands.add_parser("effects", help="which effects a scan calls for, and what decided")
    effects.add_argument("scan", metavar="SCAN")
    effects.add_argument(
        "--measure",
        action="store_true",
        help="pack and draw it as planned, with all on, and with each effect alone off: what each is worth",
    )
    effects.add_argument(
        "--out", metavar="DIR", help="with --measure: pictures of where each variant differs, and effects.json"
    )
    add_settings(effects)
    _add_work(effects)
    effects.add_argument("--json", action="store_true", help="the rows as the last line of stdout")
    _add_executor(effects)
    effects.set_defaults(command=_effects)


def _add_plan(commands) -> None:
    plan = commands.add_parser("plan", help="what a scan of any size would cost on any number of workers")
    plan.add_argument("--splats", required=True, type=_large_count, metavar="N", help="as 71e6")
    plan.add_argument("--workers", type=_count, default=24, metavar="N", help="default: 24")
    plan.add_argument("--photographs", type=int, default=400, metavar="N", help="default: 400")
    plan.add_argument("--megapixels", type=float, default=10.0, metavar="M", help="of a photograph; default: 10")
    plan.add_argument(
        "--as-measured",
        action="store_true",
        help="on the machine that the costs were measured on; default: on machines as fast as this one",
    )
    plan.add_argument("--json", action="store_true")
    add_settings(plan, ("coder", "dictionary_bits", "training_splats", "iterations"))
    plan.set_defaults(command=_plan)


def _add_compress(commands) -> None:
    compress = commands.add_parser("compress", help="a scan into a packed file, previews and a report")
    compress.add_argument(
        "scan",
        metavar="SCAN",
        help="COLMAP or nerfstudio workspace (folder or .zip), .ply, .las, .laz, .e57, .ptx, .pts, .xyz, .pcd; a volume, see iso",
    )
    _add_output(compress)
    add_settings(compress)
    add_edited_maps(compress)
    _add_strict(compress)
    _add_running(compress)
    compress.set_defaults(command=_compress)


def _add_evaluate(commands) -> None:
    evaluate = commands.add_parser(
        "evaluate", help="the tables and figures of the HPG 2021 paper, measured on a scan with photographs"
    )
    evaluate.add_argument("scan", metavar="SCAN")
    _add_output(evaluate)
    add_settings(evaluate)
    evaluate.add_argument("--rows", metavar="NAME,...", help="of Table 1; default: all")
    evaluate.add_argument(
        "--hold-out", type=_count, metavar="N", help="keep every N-th photograph out of texturing and compare with it"
    )
    _add_measuring(evaluate)
    evaluate.set_defaults(command=_evaluate)


def _add_tradeoff(commands) -> None:
    tradeoff = commands.add_parser(
        "tradeoff", help="what accuracy costs on this scan: presets, and each knob alone, measured"
    )
    tradeoff.add_argument("scan", metavar="SCAN")
    _add_output(tradeoff)
    add_settings(tradeoff)
    tradeoff.add_argument(
        "--knob",
        action="append",
        default=[],
        metavar="NAME=V1,V2,...",
        help="vary these instead of the usual; may be repeated",
    )
    tradeoff.add_argument("--budget", default="10min", metavar="TIME", help="as 90s, 10min, 2h; default: 10min")
    _add_measuring(tradeoff)
    tradeoff.set_defaults(command=_tradeoff)


def _add_estimate(commands) -> None:
    estimate = commands.add_parser(
        "estimate", help="what compress would take in seconds, memory and bytes, and give in PSNR"
    )
    estimate.add_argument("scan", metavar="SCAN")
    add_settings(estimate)
    estimate.add_argument(
        "--work", metavar="DIR", help="keep what the job will use again there, and the estimate for its report"
    )
    estimate.add_argument("--json", action="store_true", help="the estimate as the last line of stdout")
    _add_executor(estimate)
    estimate.set_defaults(command=_estimate)


def _add_reading(command: argparse.ArgumentParser) -> None:
    """The knobs of reading, for commands that only read."""
    command.set_defaults(preset=DEFAULT_PRESET)
    add_knobs(command, ("marked_points", "station", "sparse_model", "height_scale"))


def _add_strict(command: argparse.ArgumentParser) -> None:
    command.add_argument("--strict", action="store_true", help="warnings about the scan are errors: exit with 3")


def _add_output(command: argparse.ArgumentParser) -> None:
    command.add_argument("--out", required=True, metavar="DIR")
    command.add_argument("--overwrite", "-w", action="store_true", help="replace what is in DIR")
    _add_work(command)


def _add_work(command: argparse.ArgumentParser) -> None:
    command.add_argument("--work", metavar="DIR", help="keep the stages' outputs there, and use what is there already")


def _add_running(command: argparse.ArgumentParser) -> None:
    _add_measuring(command)
    command.add_argument("--require-psnr-db", type=float, metavar="DB", help="exit with 7 below this texture PSNR")


def _add_executor(command: argparse.ArgumentParser) -> None:
    command.add_argument("--workers", type=_count, metavar="N", help="worker processes; default: one a core")
    command.add_argument("--executor", choices=("dask", "serial"), default="dask")
    command.add_argument("--scheduler", metavar="tcp://...", help="a running Dask scheduler")


def _add_measuring(command: argparse.ArgumentParser) -> None:
    _add_executor(command)
    command.add_argument("--no-render", action="store_true", help="no pictures: needs no OpenGL")
    command.add_argument("--json", action="store_true", help="what was measured as the last line of stdout")


if __name__ == "__main__":
    sys.exit(main())
