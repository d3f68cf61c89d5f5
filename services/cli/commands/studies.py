"""The commands that say what accuracy and size cost: `evaluate`, `tradeoff`, `estimate` and `plan`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from services.cli.arguments import add_settings, settings_of, target_in_words
from services.cli.commands.options import (
    add_executor,
    add_measuring,
    add_output,
    atoms_a_splat,
    count,
    count_or_none,
    large_count,
    megapixels,
)
from services.cli.commands.running import executor_for, needs_photographs, progress_bars, refuse_to_overwrite, scan_path
from services.cli.exit_codes import BY_KIND, OK
from services.cli.parser import WrongArgument

if TYPE_CHECKING:
    from renderer.report.estimate_document import EstimateDocument


def _study(commands, name: str, command: Callable[[argparse.Namespace], int]) -> argparse.ArgumentParser:
    """A command that measures a scan around chosen settings, into a folder."""
    study = commands.add_parser(name)
    study.add_argument("scan", metavar="SCAN")
    add_output(study)
    add_settings(study)
    add_measuring(study)
    study.set_defaults(command=command)
    return study


def add_evaluate(commands) -> None:
    """The verb `evaluate`."""
    evaluate = _study(commands, "evaluate", _evaluate)
    evaluate.add_argument("--rows", metavar="NAME,...", help="of Table 1; default: all")
    evaluate.add_argument(
        "--hold-out", type=count, metavar="N", help="keep every N-th photograph out of texturing and compare with it"
    )
    evaluate.add_argument(
        "--pool-mib",
        type=count,
        default=512,
        metavar="N",
        help="that photographs may take on the GPU: those that take more are drawn by pages; default: 512",
    )


def _evaluate(options: argparse.Namespace) -> int:
    from msgspec import to_builtins

    from renderer.files import strict
    from services.processes.evaluate import ROWS, evaluate

    settings, out = settings_of(options), Path(options.out)
    rows = options.rows.split(",") if options.rows else ROWS
    if unknown := [row for row in rows if row not in ROWS]:
        raise WrongArgument(f"--rows has {', '.join(map(repr, unknown))}; allowed: {', '.join(ROWS)}")
    scan = scan_path(options.scan)
    refuse_to_overwrite(out, options.overwrite)
    needs_photographs(scan, settings, "there is no texture to evaluate")
    with executor_for(options) as executor:
        made = evaluate(
            scan,
            out,
            settings,
            executor,
            progress_bars(),
            rows=rows,
            hold_out=options.hold_out,
            render=not options.no_render,
            work=Path(options.work) if options.work else None,
            pool_bytes=options.pool_mib << 20,
        )
    if options.json:
        print(json.dumps({**strict(to_builtins(made)), "out": str(out)}))
    else:
        print(_table_1(made.rows))
        print(f"page  {out / 'evaluate.html'}")
    for failure in made.failed:
        print(f"splatpress: {failure.kind} error: {failure.name}: {failure.error}; all else is there", file=sys.stderr)
    return BY_KIND[made.failed[0].kind] if made.failed else OK


def _table_1(rows: Sequence) -> str:
    lines = [
        f"{'textures':<28}{'texture bytes':>15}{'B a splat':>11}{'PSNR dB':>9}{'visible':>9}{'picture':>9}{'seconds':>9}"
    ]
    for row in rows:
        psnr = [
            f"{db:9.2f}" if db is not None else f"{'exact':>9}" for db in (row.texture_psnr_db, row.visible_psnr_db)
        ]
        psnr.append(f"{row.picture_psnr_db:9.2f}" if row.picture_psnr_db is not None else f"{'-':>9}")
        name = f"{row.name}, {row.coder}" if row.kind == "ours" else row.name
        lines.append(
            f"{name:<28}{row.texture_bytes:>15,}{row.bytes_per_splat:>11.2f}{''.join(psnr)}{row.seconds:>9.1f}"
        )
    return "\n".join(lines)


def add_tradeoff(commands) -> None:
    """The verb `tradeoff`."""
    tradeoff = _study(commands, "tradeoff", _tradeoff)
    tradeoff.add_argument(
        "--knob",
        action="append",
        default=[],
        metavar="NAME=V1,V2,...",
        help="vary these instead of the usual; may be repeated",
    )
    tradeoff.add_argument("--budget", default="10min", metavar="TIME", help="as 90s, 10min, 2h; default: 10min")


def _tradeoff(options: argparse.Namespace) -> int:
    from msgspec import to_builtins

    from renderer.files import strict
    from services.processes.tradeoff import parsed_budget, parsed_knobs, tradeoff

    settings, out = settings_of(options), Path(options.out)
    try:
        budget_s, knobs = parsed_budget(options.budget), parsed_knobs(options.knob) if options.knob else None
    except ValueError as error:
        raise WrongArgument(str(error)) from error
    scan = scan_path(options.scan)
    refuse_to_overwrite(out, options.overwrite)
    if options.no_render:
        needs_photographs(scan, settings, "without them and without pictures nothing tells accuracy")
    with executor_for(options) as executor:
        made = tradeoff(
            scan,
            out,
            settings,
            executor,
            progress_bars(),
            knobs=knobs,
            budget_s=budget_s,
            render=not options.no_render,
            work=Path(options.work) if options.work else None,
        )
    if options.json:
        print(json.dumps({**strict(to_builtins(made)), "out": str(out)}))
    else:
        print(
            f"{'':<28}{'pictures':>11}{'textures':>11}{'splats':>13}{'file':>15}{'seconds':>9}  on the front of bytes"
        )
        front = set(made.fronts["file_bytes"])
        for p in made.points:
            psnrs = "".join(
                f"{'-':>11}" if db is None else f"{db:8.2f} dB" for db in (p.picture_psnr_db, p.texture_psnr_db)
            )
            print(
                f"{p.key:<28}{psnrs}{p.splats:13,}{p.file_bytes:13,} B"
                f"{p.seconds:9.1f}  {'yes' if p.key in front else ''}".rstrip()
                + (f"  changes nothing here: the splats of {p.same_as}" if p.same_as else "")
            )
        print(f"page  {out / 'tradeoff.html'}")
    return OK


def add_estimate(commands) -> None:
    """The verb `estimate`."""
    estimate = commands.add_parser("estimate")
    estimate.add_argument("scan", metavar="SCAN")
    add_settings(estimate)
    estimate.add_argument(
        "--work", metavar="DIR", help="keep what the job will use again there, and the estimate for its report"
    )
    estimate.add_argument("--json", action="store_true", help="the estimate as the last line of stdout")
    add_executor(estimate)
    estimate.set_defaults(command=_estimate)


def _estimate(options: argparse.Namespace) -> int:
    from msgspec import to_builtins

    from renderer.files import strict
    from services.processes.estimate import estimate

    settings, scan = settings_of(options), scan_path(options.scan)
    work = Path(options.work) if options.work else None
    if work:
        work.mkdir(parents=True, exist_ok=True)
    with executor_for(options) as executor:
        found = estimate(scan, settings, executor, progress_bars(), work)
    print(json.dumps(strict(to_builtins(found))) if options.json else _estimate_lines(found))
    if words := target_in_words(options, found.texture_psnr_db is not None):
        print(words, file=sys.stderr if options.json else sys.stdout)
    return OK


def _estimate_lines(found: EstimateDocument) -> str:
    from renderer.report.report_words import ESTIMATE

    lines = [
        f"{title:<24} {say(figure.value):>14}   {say(figure.low)} to {say(figure.high)}"
        for name, title, say in ESTIMATE
        if (figure := getattr(found, name))
    ]
    lines.append(f"{'Bytes a splat':<24} {found.bytes_per_splat:>14.2f}")
    if found.sizes.dictionary_bytes and not {"ksvd-update"} & {stage.name for stage in found.stages}:
        lines.append("atoms ship with the program: no time of learning, and none in the file")
    return "\n".join(
        [
            *lines,
            f"from {found.sample.n_splats:,} of {found.splats:,} splats; up to the packed file, with {found.n_workers} workers",
        ]
    )


def add_plan(commands) -> None:
    """The verb `plan`."""
    plan = commands.add_parser("plan")
    plan.add_argument("--splats", required=True, type=large_count, metavar="N", help="as 71e6")
    plan.add_argument("--workers", type=count, default=24, metavar="N", help="default: 24")
    plan.add_argument("--photographs", type=count_or_none, default=400, metavar="N", help="default: 400")
    plan.add_argument("--megapixels", type=megapixels, default=10.0, metavar="M", help="of a photograph; default: 10")
    plan.add_argument(
        "--as-measured",
        action="store_true",
        help="on the machine that the costs were measured on; default: on machines as fast as this one",
    )
    plan.add_argument("--pages", action="store_true", help="with the photographs in pages beside it")
    plan.add_argument(
        "--atoms-a-splat",
        type=atoms_a_splat,
        metavar="N",
        help="on average, as a report says of a scan like it; default: 1.73, as `fountain_p11` with balanced takes; "
        "monstree takes 5.95",
    )
    kinds = plan.add_mutually_exclusive_group()
    kinds.add_argument(
        "--voxels",
        type=large_count,
        default=0,
        metavar="N",
        help="of a volume whose surfaces have so many splats, as 832e6",
    )
    kinds.add_argument(
        "--stations",
        type=count,
        default=0,
        metavar="N",
        help="of a laser scan that is textured from their maps, in place of photographs",
    )
    plan.add_argument("--json", action="store_true")
    add_settings(plan, ("coder", "dictionary_bits", "training_splats", "iterations", "geometry"))
    plan.set_defaults(command=_plan)


def _plan(options: argparse.Namespace) -> int:
    from services.processes.plan import as_text, plan, speed_of_this_machine

    speed = 1.0 if options.as_measured else speed_of_this_machine()
    found = plan(
        options.splats,
        options.workers,
        settings_of(options),
        options.photographs,
        options.megapixels,
        speed,
        options.pages,
        options.voxels,
        options.stations,
        **({} if options.atoms_a_splat is None else {"atoms": options.atoms_a_splat}),
    )
    print(json.dumps(found) if options.json else as_text(found))
    return OK
