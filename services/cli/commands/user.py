"""The commands that speak with a service: `login`, `upload`, `submit`, `watch`, `fetch` and others."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from pipeline.planning.knobs import BY_NAME
from services.cli.arguments import add_preset
from services.cli.commands.running import asked_token, program
from services.cli.exit_codes import BY_KIND, GATE_MISSED, INPUT_OUTPUT, OK
from services.cli.parser import WrongArgument
from services.processes.kinds import COMPRESS, PERFORMANCE, PROCESSES

DEFAULT_URL = "http://127.0.0.1:8000"


def add_user(commands) -> None:
    """The verbs."""
    login = _verb(commands, "login", _login)
    login.add_argument("--token", help="default: asked for")
    _verb(commands, "logout", _logout)
    upload = _verb(commands, "upload", _upload)
    upload.add_argument("scan", type=Path)
    submit = _verb(commands, "submit", _submit)
    submit.add_argument("scan")
    add_preset(submit)
    submit.add_argument("--option", action="append", default=[], metavar="NAME=VALUE")
    submit.add_argument(
        "--pages", action="store_true", help="photographs in pages beside it: --option effects=pages=on"
    )
    submit.add_argument("--process", choices=PROCESSES, default=COMPRESS)
    submit.add_argument(
        "--knob",
        action="append",
        default=[],
        metavar="NAME=V1,V2,...",
        help="that a tradeoff varies, instead of the usual",
    )
    submit.add_argument("--budget", metavar="TIME", help="of a tradeoff: 90s, 10min, 2h")
    submit.add_argument("--seed", type=int, default=0)
    submit.add_argument("--name", default="")
    submit.add_argument("--webhook")
    submit.add_argument("--key", help="submitting again with the same key gives the same job")
    submit.add_argument("--watch", action="store_true")
    for name, function in (("watch", _watch), ("status", _status), ("cancel", _cancel), ("retry", _retry)):
        _verb(commands, name, function).add_argument("job")
    logs = _verb(commands, "logs", _logs)
    logs.add_argument("job")
    logs.add_argument("--level", default="info", choices=("debug", "info", "warning", "error"))
    fetch = _verb(commands, "fetch", _fetch)
    fetch.add_argument("job")
    fetch.add_argument("names", nargs="*", help=f"of artifacts; without any, all but {PERFORMANCE}, of the workers")
    fetch.add_argument("--out", type=Path, required=True, metavar="DIR")
    ls = _verb(commands, "ls", _ls)
    ls.add_argument("--status", choices=("accepted", "running", "successful", "failed", "dismissed"))
    ls.add_argument("--limit", type=int, default=100)
    regress = _verb(commands, "regress", _regress)
    regress.add_argument("jobs", type=Path, metavar="jobs.toml")
    regress.add_argument("--update", action="store_true", help="write what was measured as what is expected")


def _verb(commands, name: str, function) -> argparse.ArgumentParser:
    verb = commands.add_parser(name)
    verb.add_argument("--url", help=f"of the service; default: the last login's, or {DEFAULT_URL}")
    verb.add_argument("--json", action="store_true")
    verb.set_defaults(command=function)
    return verb


def _login_file() -> Path:
    base = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    return Path(base) / "splatpress" / "login.json"


def _login(options: argparse.Namespace) -> int:
    from services.cli.client import Client

    url = options.url or DEFAULT_URL
    token = options.token if options.token is not None else asked_token()
    with Client(url, token or None) as client:
        client.ls(limit=1)
    path = _login_file()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    with open(os.open(path, os.O_WRONLY | os.O_CREAT, 0o600), "w") as stream:
        json.dump({"url": url, "token": token}, stream)
    print(f"logged in at {url}")
    return OK


def _logout(options: argparse.Namespace) -> int:
    _login_file().unlink(missing_ok=True)
    print("logged out")
    return OK


def _client(options: argparse.Namespace):
    from services.cli.client import Client

    saved = json.loads(_login_file().read_text()) if _login_file().is_file() else {}
    url = options.url or os.environ.get("SPLATPRESS_URL") or saved.get("url", DEFAULT_URL)
    token = os.environ.get("SPLATPRESS_TOKEN") or (saved.get("token") if url == saved.get("url") else None)
    return Client(url, token or None)


def _print(options: argparse.Namespace, document: dict | list, line: str) -> int:
    print(json.dumps(document) if options.json else line)
    return OK


def _upload_path(client, path: Path) -> dict:
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    from tqdm import tqdm

    with tqdm(
        total=None, unit="B", unit_scale=True, desc="upload", file=sys.stderr, disable=not sys.stderr.isatty()
    ) as bar:

        def on_progress(sent: int, total: int) -> None:
            bar.total = total
            bar.update(sent - bar.n)

        return client.upload(path, on_progress)


def _upload(options: argparse.Namespace) -> int:
    with _client(options) as client:
        scan = _upload_path(client, options.scan)
    for warning in scan["warnings"]:
        print(f"warning: {warning}", file=sys.stderr)
    return _print(options, scan, scan["id"])


def _submit(options: argparse.Namespace) -> int:
    with _client(options) as client:
        is_id = len(options.scan) == 64 and not Path(options.scan).exists()
        is_url = options.scan.startswith(("https://", "http://", "s3://"))
        found = (
            client.fetch_scan(options.scan) if is_url else None if is_id else _upload_path(client, Path(options.scan))
        )
        scan = found["id"] if found else options.scan
        request = {
            "preset": options.preset,
            "options": _with_pages(_pairs(options.option), options.pages),
            "seed": options.seed,
            "name": options.name,
            **_process(options),
        }
        job = client.submit(
            scan, key=options.key, **request, **({"webhook": options.webhook} if options.webhook else {})
        )
        if options.watch:
            return _watched(client, job["jobID"], options)
        if not options.json:
            _say_next(f"watch {job['jobID']}", client)
    return _print(options, job, job["jobID"])


def _with_pages(asked: dict, pages: bool) -> dict:
    return asked | {"effects": f"{asked['effects']},pages=on" if "effects" in asked else "pages=on"} if pages else asked


def _say_next(words: str, client) -> None:
    """Beside the result, which scripts read from standard output."""
    print(f"next: {program()} {words}   (page: {client.url.rstrip('/')}/)", file=sys.stderr)


def _process(options: argparse.Namespace) -> dict:
    """What a request says of a process other than compress."""
    from services.processes.tradeoff import parsed_budget, parsed_knobs

    if options.process == COMPRESS:
        return {}
    try:
        return {
            "process": options.process,
            **({"knobs": parsed_knobs(options.knob)} if options.knob else {}),
            **({"budget_s": parsed_budget(options.budget)} if options.budget else {}),
        }
    except ValueError as error:
        raise WrongArgument(str(error)) from error


def _pairs(texts: list[str]) -> dict:
    pairs = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or name not in BY_NAME:
            raise WrongArgument(f"--option {text!r} is not NAME=VALUE with one of the names {', '.join(BY_NAME)}")
        try:
            pairs[name] = BY_NAME[name].parsed(value)
        except ValueError as error:
            raise WrongArgument(str(error)) from error
    return pairs


def _watch(options: argparse.Namespace) -> int:
    with _client(options) as client:
        return _watched(client, options.job, options)


def _watched(client, id: str, options: argparse.Namespace) -> int:
    job = client.watch(id, _show_event)
    if job["problem"]:
        print(f"splatpress: {job['problem']['class']} error: {job['problem']['detail']}", file=sys.stderr)
    _print(options, job, f"{job['jobID']} {job['status']}")
    kind = (job["problem"] or {}).get("class")
    if not options.json:
        _say_next(f"fetch {id} --out DIR" if job["status"] == "successful" else f"logs {id}, then retry {id}", client)
    return OK if job["status"] == "successful" else BY_KIND.get(kind, INPUT_OUTPUT)


def _show_event(event: dict) -> None:
    data = event["data"]
    if event["kind"] == "progress":
        parts = [f"{data['progress']:3d} %", data["stage"]]
        parts += [f"{data['splats_per_second']:,} splats/s"] if data["splats_per_second"] else []
        parts += [f"{data['seconds_left']:.0f} s left"] if data["seconds_left"] is not None else []
        parts += [f"training patches at {data['psnr_db']:.2f} dB"] if data["psnr_db"] is not None else []
        end = "\n" if not sys.stderr.isatty() else ""
        print(("" if end else "\r\033[K") + ", ".join(parts), end=end, file=sys.stderr, flush=True)
    elif event["kind"] == "log" and data["level"] != "debug":
        print(("\r\033[K" if sys.stderr.isatty() else "") + data["message"], file=sys.stderr)


def _status(options: argparse.Namespace) -> int:
    with _client(options) as client:
        job = client.status(options.job)
    return _print(
        options, job, "\n".join(f"{key}: {value}" for key, value in job.items() if key not in ("links", "settings"))
    )


def _cancel(options: argparse.Namespace) -> int:
    with _client(options) as client:
        job = client.cancel(options.job)
    return _print(options, job, f"{job['jobID']} {job['status']}")


def _retry(options: argparse.Namespace) -> int:
    with _client(options) as client:
        job = client.retry(options.job)
    return _print(options, job, f"{job['jobID']} {job['status']}")


def _logs(options: argparse.Namespace) -> int:
    with _client(options) as client:
        for line in client.logs(options.job, options.level):
            _print(options, line, f"{line['time']} {line['level']:<7} {line['message']}")
    return OK


def _fetch(options: argparse.Namespace) -> int:
    with _client(options) as client:
        made = [] if options.names else [artifact["name"] for artifact in client.artifacts(options.job)]
        paths = client.fetch(options.job, options.out, options.names or [n for n in made if n != PERFORMANCE])
    missing = set(options.names) - {p.relative_to(options.out).as_posix() for p in paths}
    if missing:
        print(f"splatpress: job {options.job} has no {', '.join(sorted(missing))}", file=sys.stderr)
        return INPUT_OUTPUT
    return _print(options, [str(p) for p in paths], "\n".join(str(p) for p in paths))


def _ls(options: argparse.Namespace) -> int:
    with _client(options) as client:
        jobs = client.ls(limit=options.limit, **({"status": options.status} if options.status else {}))
    if not (jobs or options.json):
        print(f"no jobs{f' that are {options.status}' if options.status else ''}", file=sys.stderr)
        return OK
    return _print(
        options,
        jobs,
        "\n".join(
            f"{j['jobID']}  {j['status']:<10}  {j['progress']:3d} %  {j['created'][:19]}  {j['name']}" for j in jobs
        ),
    )


def _regress(options: argparse.Namespace) -> int:
    from services.cli.regress import regress

    with _client(options) as client:
        rows = regress(client, options.jobs, options.update)
    if options.json:
        print(json.dumps(rows))
    return OK if options.update or all(row["ok"] for row in rows) else GATE_MISSED
