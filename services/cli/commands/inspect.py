"""The commands that read and make nothing: `inspect` and `check`."""

from __future__ import annotations

import argparse
import json

from services.cli.arguments import settings_of
from services.cli.commands.options import add_reading, add_strict
from services.cli.commands.running import scan_path
from services.cli.exit_codes import INVALID_INPUT, OK


def add_inspect(commands) -> None:
    """The verb `inspect`."""
    inspect = commands.add_parser("inspect")
    inspect.add_argument("path", metavar="SCAN-or-PACKED")
    inspect.add_argument("--json", action="store_true")
    add_reading(inspect)
    inspect.set_defaults(command=_inspect)


def _inspect(options: argparse.Namespace) -> int:
    from services.processes.inspect import inspect

    settings = settings_of(options)
    found = inspect(scan_path(options.path), settings.reading, settings.choice)
    print(json.dumps(found) if options.json else _as_lines(found))
    return OK


def add_check(commands) -> None:
    """The verb `check`."""
    check = commands.add_parser("check")
    check.add_argument("path", metavar="SCAN")
    check.add_argument("--json", action="store_true")
    add_reading(check)
    add_strict(check)
    check.set_defaults(command=_check)


def _check(options: argparse.Namespace) -> int:
    from services.processes.inspect import check

    settings = settings_of(options)
    found = check(scan_path(options.path), settings.reading, options.strict, settings.choice)
    if options.json:
        print(json.dumps(found))
    else:
        for finding in found["findings"]:
            print(f"{finding['severity']}: {finding['text']}")
        print("ok: compress takes it" if found["ok"] else "not ok: see above")
    return OK if found["ok"] else INVALID_INPUT


def _as_lines(found: dict, indent: str = "") -> str:
    lines = []
    for key, value in found.items():
        if isinstance(value, dict) and value:
            lines += [f"{indent}{key}:", _as_lines(value, indent + "  ")]
        elif isinstance(value, list) and value and all(isinstance(v, str) for v in value):
            lines += [f"{indent}{key}:"] + [f"{indent}  {v}" for v in value]
        elif value in ([], {}, ""):
            lines.append(f"{indent}{key}: none")
        elif value is None:  # a header that does not say, or a setting that nobody asked for
            lines.append(f"{indent}{key}: {'unknown' if key == 'bounds' else 'none'}")
        else:
            lines.append(f"{indent}{key}: {value}")
    return "\n".join(lines)
