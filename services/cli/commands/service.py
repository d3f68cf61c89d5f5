"""The commands that are a service, or look after one: `serve`, `api`, `runner`, `token`, `backup`, `restore`."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from services.cli.exit_codes import OK
from services.cli.parser import WrongArgument


def add_service(commands) -> None:
    """The verbs."""
    for name, function in (("serve", _serve), ("api", _api), ("runner", _runner)):
        verb = commands.add_parser(name)
        verb.add_argument("--data", type=Path, metavar="DIR", help="default: splatpress-data")
        verb.add_argument("--host", help="default: 127.0.0.1; any other address asks for tokens")
        verb.add_argument("--port", type=int)
        verb.add_argument(
            "--require-tokens", action="store_true", default=None, help="on loopback too, as behind a proxy"
        )
        verb.add_argument("--workers", type=int, metavar="N", help="default: one a core")
        verb.add_argument(
            "--scheduler", metavar="tcp://...", help="a running Dask scheduler, instead of workers of its own"
        )
        if name != "serve":
            verb.add_argument("--end-with-stdin", action="store_true", help=argparse.SUPPRESS)
        verb.set_defaults(command=function)
    token = commands.add_parser("token")
    token.add_argument("owner")
    token.add_argument("--data", type=Path, metavar="DIR")
    token.add_argument("--label", default="", help="to tell it from others")
    token.add_argument("--days", type=float, help="how long it is good; default: for ever")
    token.add_argument("--list", action="store_true", help="the owner's tokens by their ids, instead")
    token.add_argument("--revoke", metavar="ID", help="a token of the owner's, instead")
    token.set_defaults(command=_token)
    for name, function, what in (("backup", _backup, "to write"), ("restore", _restore, "that backup wrote")):
        verb = commands.add_parser(name)
        verb.add_argument("file", type=Path, help=f"a .tar {what}")
        verb.add_argument("--data", type=Path, metavar="DIR", help="default: splatpress-data")
        verb.set_defaults(command=function)


def _settings(options: argparse.Namespace):
    from services.settings import settings_from

    names = ("data", "host", "port", "workers", "scheduler", "require_tokens")
    try:
        return settings_from(None, **{name: getattr(options, name, None) for name in names})
    except ValueError as error:
        raise WrongArgument(str(error)) from error


def _serve(options: argparse.Namespace) -> int:
    from services.cli.serve import serve

    return serve(_settings(options))


def _api(options: argparse.Namespace) -> int:
    from services.cli.serve import run_api
    from services.cli.supervise import end_with_stdin

    if options.end_with_stdin:
        end_with_stdin()
    run_api(_settings(options))
    return OK


def _runner(options: argparse.Namespace) -> int:
    from services.cli.supervise import end_with_stdin
    from services.jobs.runner import run_forever

    if options.end_with_stdin:
        end_with_stdin()
    run_forever(_settings(options))
    return OK


def _token(options: argparse.Namespace) -> int:
    from services.store.store import Store
    from services.store.tokens import ID_LENGTH, add_token, revoke_token, tokens_of

    store = Store(_settings(options).database_url)
    if options.revoke:
        if not revoke_token(store, options.owner, options.revoke):
            raise WrongArgument(f"{options.owner} has no token {options.revoke!r}; --list names them")
        print(f"revoked {options.revoke}")
    elif options.list:
        day = lambda seconds: time.strftime("%Y-%m-%d", time.gmtime(seconds)) if seconds else "never"
        for row in tokens_of(store, options.owner):
            id, made, used, ends = row.hash[:ID_LENGTH], row.created, row.used, row.expires
            print(f"{id}  made {day(made)}  used {day(used):<10}  expires {day(ends):<10}  {row.label}")
    else:
        lasts_s = None if options.days is None else options.days * 86_400
        print(add_token(store, options.owner, options.label, lasts_s)[0])
    return OK


def _backup(options: argparse.Namespace) -> int:
    from services.jobs.backup import back_up

    settings = _settings(options)
    if not settings.data.is_dir():
        raise FileNotFoundError(f"{settings.data}: no such data folder")
    made = back_up(settings, options.file)
    for name in made.missing:
        print(f"splatpress: warning: {name} is named by the database and not there", file=sys.stderr)
    print(f"{options.file}: {_counts(made)}")
    return OK


def _restore(options: argparse.Namespace) -> int:
    from services.jobs.backup import restore

    settings = _settings(options)
    found = restore(settings, options.file)
    print(f"{settings.data}: {_counts(found)}; next: splatpress serve --data {settings.data}")
    return OK


def _counts(backup) -> str:
    rows = ", ".join(f"{backup.rows[name]} {name}" for name in ("scans", "jobs", "artifacts", "tokens"))
    return f"{rows}; {backup.n_files} files of {backup.n_bytes:,} bytes"
