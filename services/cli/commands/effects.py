"""The command `effects`: what a scan calls for, and what each effect is worth."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from services.cli.arguments import add_settings, settings_of
from services.cli.commands.options import add_executor, add_work
from services.cli.commands.running import executor_for, progress_bars, scan_path
from services.cli.exit_codes import OK


def add_effects(commands) -> None:
    """The verb `effects`."""
    effects = commands.add_parser("effects")
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
    add_work(effects)
    effects.add_argument("--json", action="store_true", help="the rows as the last line of stdout")
    add_executor(effects)
    effects.set_defaults(command=_effects)


def _effects(options: argparse.Namespace) -> int:
    from services.processes.effects import effects_of, worth_of_effects

    settings, scan = settings_of(options), scan_path(options.scan)
    work = Path(options.work) if options.work else None
    if options.measure:
        with executor_for(options) as executor:
            found = worth_of_effects(
                scan, settings, executor, progress_bars(), work, Path(options.out) if options.out else None
            )
        print(json.dumps(found) if options.json else _variant_lines(found["variants"]))
        return OK
    with executor_for(options) as executor:
        rows = effects_of(scan, settings, executor, progress_bars(), work)
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
