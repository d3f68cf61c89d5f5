"""What data in a bucket costs: a job over S3, by two workers that share no folder and no network, beside `compress`.

    python -m benchmarks.bucket SCAN [--pairs 3] [--preset draft] [--cache-bytes N] [--json]

Each worker stands in a network namespace of its own, with a cable to the scheduler and the server of objects (moto's,
one process), and sees of this machine's data folder an empty one; where namespaces are not permitted it has folders of
its own alone, and the answer says so. Command and job alternate, each job on a new prefix. Seconds of the command count
from its start to its end, of the job from its submission to its end. The server takes processor time of the same cores.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

from benchmarks.service import _by_command, _by_job
from tests.services.bucket import BUCKET, bucket_environment, s3_server
from tests.services.service_process import ROOT, free_port, service

WORKERS = 2


def measure(scan: Path, pairs: int, preset: str, cache_bytes: int) -> dict:
    rows = []
    with tempfile.TemporaryDirectory() as folder, s3_server("0.0.0.0") as port, ExitStack() as stack:
        base = Path(folder)
        os.environ.update(bucket_environment(port), SPLATPRESS_CACHE_BYTES=str(cache_bytes))
        shut_in = [stack.enter_context(_namespace(i)) for i in range(WORKERS)]
        for i in range(pairs):
            command_s = _by_command(scan, base / f"out-{i}", preset)
            with ExitStack() as one:
                told = _job(one, base / str(i), scan, preset, port, shut_in)
            same = told.pop("packed") == _packed(base / f"out-{i}")
            rows.append({"command_s": command_s, **told, "ratio": told["job_s"] / command_s, "same_bytes": same})
            print(rows[-1], file=sys.stderr, flush=True)
    return {
        "preset": preset,
        "shut_in": all(shut_in),
        "cache_bound_bytes": cache_bytes,
        "pairs": rows,
        "median_ratio": statistics.median(row["ratio"] for row in rows),
    }


def _packed(folder: Path) -> bytes:
    (path,) = folder.glob("*.splatpress")
    return path.read_bytes()


def _job(stack: ExitStack, base: Path, scan: Path, preset: str, port: int, shut_in: list[tuple | None]) -> dict:
    base.mkdir()
    dask, at = str(Path(sys.executable).with_name("dask")), free_port()
    _process(
        stack, base / "scheduler", [dask, "scheduler", "--host", "tcp://0.0.0.0", "--port", str(at), "--no-dashboard"]
    )
    places = [*shut_in, None]
    for i, place in enumerate(places):
        resource = "CPU=1" if i < WORKERS else "GL=1"
        host, prefix = ("127.0.0.1", []) if place is None else (place[1], ["ip", "netns", "exec", place[0]])
        own = base / f"worker-{i}"
        command = [*prefix, *_blind(prefix, base / "data"), dask, "worker", f"tcp://{host}:{at}", "--nworkers", "1"]
        command += [
            "--nthreads",
            "1",
            "--no-dashboard",
            "--resources",
            resource,
            "--local-directory",
            str(own / "dask"),
        ]
        _process(stack, own, command, SPLATPRESS_CACHE=str(own / "cache"), **bucket_environment(port, host))
    (base / "data").mkdir(exist_ok=True)
    os.environ["SPLATPRESS_CACHE"] = str(base / "runner-cache")
    with service(
        base / "data", objects=f"s3://{BUCKET}/{base.name}", scheduler=f"tcp://127.0.0.1:{at}", log=base / "log"
    ) as served:
        most: dict[str, int] = {}
        stop = threading.Event()
        watching = threading.Thread(target=_watch, args=(base, most, stop))
        watching.start()
        told = _by_job(served, scan, preset)
        stop.set()
        watching.join()
        (job,) = served.client.ls()
        served.client.fetch(job["jobID"], base / "got")
    return {**told, "most_cached_bytes": max(most.values()), "packed": _packed(base / "got")}


def _blind(prefix: list[str], data: Path) -> list[str]:
    """What runs after it sees an empty folder in place of the data folder."""
    data.mkdir(exist_ok=True)
    script = f'mount -t tmpfs none {data} && exec "$@"'
    return ["unshare", "--mount", "sh", "-c", script, "sh"] if prefix else []


def _process(stack: ExitStack, own: Path, command: list[str], **environment: str) -> None:
    """Ends with the stack."""
    own.mkdir(parents=True, exist_ok=True)
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    dask = {
        "DASK_DISTRIBUTED__WORKER__PRELOAD": "['pipeline.warm']",
        "DASK_DISTRIBUTED__WORKER__MEMORY__SPILL": "false",
    }
    log = stack.enter_context(open(own / "log", "w"))
    process = subprocess.Popen(
        command,
        env={**os.environ, **one, **dask, "PYTHONPATH": str(ROOT), **environment},
        cwd=own,
        stdout=log,
        stderr=subprocess.STDOUT,
    )

    def end() -> None:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()

    stack.callback(end)


def _watch(base: Path, most: dict[str, int], stop: threading.Event) -> None:
    """The most bytes that each cache was seen with."""
    while not stop.wait(0.2):
        for cache in [p for root in base.rglob("*cache") for p in (root.iterdir() if root.is_dir() else ())]:
            try:
                n = sum(p.stat().st_size for p in cache.rglob("*") if p.is_file())
            except OSError:
                continue
            most[cache.name] = max(most.get(cache.name, 0), n)


@contextmanager
def _namespace(index: int):
    """A network of its own with one cable to ours: (its name, our address there); None where it is not permitted."""
    name, ours, theirs, net = f"splat-s3-{index}", f"splat-s3-{index}a", f"splat-s3-{index}b", f"10.213.{20 + index}"
    try:
        for command in (
            f"netns add {name}",
            f"link add {ours} type veth peer name {theirs} netns {name}",
            f"addr add {net}.1/24 dev {ours}",
            f"link set {ours} up",
            f"-n {name} addr add {net}.2/24 dev {theirs}",
            f"-n {name} link set {theirs} up",
            f"-n {name} link set lo up",
        ):
            subprocess.run(["ip", *command.split()], check=True, capture_output=True)
        place = name, f"{net}.1"
    except (OSError, subprocess.CalledProcessError):
        place = None
    try:
        yield place
    finally:
        subprocess.run(["ip", "netns", "delete", name], capture_output=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--cache-bytes", type=int, default=1 << 30)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    begun = time.perf_counter()
    found = measure(options.scan, options.pairs, options.preset, options.cache_bytes)
    found["seconds"] = time.perf_counter() - begun
    print(json.dumps(found) if options.json else "\n".join(f"{name}: {value}" for name, value in found.items()))


if __name__ == "__main__":
    main()
