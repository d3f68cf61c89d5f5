"""What the service costs on top of `splatpress compress`, and how its API answers while many jobs run.

    python -m benchmarks.service overhead [--scan DIR] [--pairs 5] [--json]
    python -m benchmarks.service storm [--jobs 200] [--json]
    python -m benchmarks.service viewers [--viewers 100] [--points 200000] [--json]

overhead: the same scan by the command and by a job, alternately; each time with another file beside the photographs, so
that no job finds its stages done. Seconds of the command count from its start to its end, of the job from its
submission to its end; the ratio is the median over the pairs. The embedded service and the command have as many
workers. storm: that many jobs on one small scan, all submitted at once, each with another seed; meanwhile the API is
asked for the list of jobs, for one of them and for its log, in turn, every 50 ms. viewers: that many load one packed
file at once, each as the page does (the page, its script, its shaders, the end of the file, its beginning, then ranges
of 512 kB), on a connection of its own, `ROUNDS` times, in a process of their own; the API is asked meanwhile as above.
Processor seconds of both sides are told: they share this machine.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import httpx

from benchmarks.needs import packages_of_tests

with packages_of_tests():
    import psutil

    from tests.services.scans import photo_scan, point_scan
    from tests.services.service_process import service

WORKERS = 2
ASK_EVERY_S = 0.05
ROUNDS, TAIL_BYTES, RANGE_BYTES = 3, 1 << 15, 1 << 19


def overhead(scan: Path | None, pairs: int, preset: str) -> dict:
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        source = base / "scan"
        if scan is None:
            photo_scan(source)
        else:
            shutil.copytree(scan, source)
        with service(base / "data", workers=WORKERS) as served:
            for i in range(pairs):
                (source / "note.txt").write_text(f"pair {i}")
                rows.append(
                    {"command_s": _by_command(source, base / f"out-{i}", preset), **_by_job(served, source, preset)}
                )
    ratios = [row["job_s"] / row["command_s"] for row in rows]
    return {"preset": preset, "pairs": rows, "median_ratio": statistics.median(ratios), "ratios": ratios}


def _by_command(scan: Path, out: Path, preset: str) -> float:
    begun = time.perf_counter()
    subprocess.run(
        [
            sys.executable,
            "-m",
            "services.cli",
            "compress",
            str(scan),
            "--out",
            str(out),
            "--preset",
            preset,
            "--workers",
            str(WORKERS),
        ],
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    return time.perf_counter() - begun


def _by_job(served, scan: Path, preset: str) -> dict:
    begun = time.perf_counter()
    id = served.client.upload(scan)["id"]
    uploaded = time.perf_counter()
    job = served.client.watch(served.client.submit(id, preset=preset)["jobID"], lambda event: None)
    assert job["status"] == "successful", job["problem"]
    return {"upload_s": uploaded - begun, "job_s": time.perf_counter() - uploaded}


def storm(n_jobs: int) -> dict:
    with tempfile.TemporaryDirectory() as folder, service(Path(folder) / "data", workers=WORKERS) as served:
        scan = served.client.upload(point_scan(Path(folder) / "ball.ply", 300))["id"]
        begun = time.perf_counter()
        jobs = [served.client.submit(scan, preset="draft", seed=i)["jobID"] for i in range(n_jobs)]
        submitted = time.perf_counter() - begun
        stop, answers = threading.Event(), []
        asking = threading.Thread(target=_ask, args=(served.url, jobs, answers, stop))
        asking.start()
        while served.client.ls(status="accepted", limit=1) or served.client.ls(status="running", limit=1):
            time.sleep(1)
        took = time.perf_counter() - begun
        stop.set()
        asking.join()
        ended = [served.client.status(job) for job in jobs]
    return {
        "jobs": n_jobs,
        "successful": sum(job["status"] == "successful" for job in ended),
        "problems": sorted({str(job["problem"]) for job in ended if job["problem"]}),
        "submit_s": submitted,
        "all_s": took,
        **_percentiles(answers),
    }


def viewers(n_viewers: int, n_points: int) -> dict:
    with tempfile.TemporaryDirectory() as folder, service(Path(folder) / "data", workers=WORKERS) as served:
        scan = served.client.upload(point_scan(Path(folder) / "ball.ply", n_points))["id"]
        job = served.client.watch(served.client.submit(scan, preset="draft")["jobID"], lambda event: None)
        assert job["status"] == "successful", job["problem"]
        (packed,) = (a for a in served.client.artifacts(job["jobID"]) if a["name"].endswith(".splatpress"))
        stop, answers, api = threading.Event(), [], served.part("api")
        asking = threading.Thread(target=_ask, args=(served.url, [job["jobID"]], answers, stop))
        before = _processor_s(api)
        asking.start()
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            found = pool.submit(_look_all, served.url, packed, n_viewers).result()
        stop.set()
        asking.join()
        api_s = _processor_s(api) - before
    loads = found.pop("loads")
    return {
        "viewers": n_viewers,
        "file_bytes": packed["bytes"],
        **found,
        "bytes_a_s": n_viewers * ROUNDS * packed["bytes"] / found["all_s"],
        "median_load_s": statistics.median(loads),
        "api_processor_s": api_s,
        **_percentiles(answers),
    }


def _processor_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system


def _look_all(url: str, packed: dict, n_viewers: int) -> dict:
    """All viewers in one process: seconds of each load, of all, and of this process's processor."""
    begun, before = time.perf_counter(), time.process_time()

    async def together() -> list[list[float]]:
        return await asyncio.gather(*(_look(url, packed) for _ in range(n_viewers)))

    loads = [seconds for each in asyncio.run(together()) for seconds in each]
    return {"loads": loads, "all_s": time.perf_counter() - begun, "clients_processor_s": time.process_time() - before}


async def _look(url: str, packed: dict) -> list[float]:
    """One viewer of a file: ROUNDS times all that its page asks for."""
    host, port = url.removeprefix("http://").split(":")
    size, loads = packed["bytes"], []
    ranges = [(start, min(start + RANGE_BYTES, size) - 1) for start in range(0, size, RANGE_BYTES)]
    spans = (f"-{TAIL_BYTES}", *(f"{start}-{last}" for start, last in ranges))
    asked = [*(f"GET {path}" for path in ("/view", "/web/viewer/page.js", "/web/viewer/shaders.json"))]
    asked += [f"GET {packed['href'].removeprefix(url)} {span}" for span in spans]
    reader, writer = await asyncio.open_connection(host, int(port))
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        for line in asked:
            method, path, *span = line.split()
            range_of = f"Range: bytes={span[0]}\r\n" if span else ""
            writer.write(f"{method} {path} HTTP/1.1\r\nHost: {host}:{port}\r\n{range_of}\r\n".encode())
            head = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
            assert head.startswith(("http/1.1 200", "http/1.1 206")), head
            await reader.readexactly(int(head.split("content-length: ")[1].split("\r\n")[0]))
        loads.append(time.perf_counter() - begun)
    writer.close()
    return loads


def _percentiles(answers: list[float]) -> dict:
    answers.sort()
    of = {f"p{p}_ms": 1000 * answers[min(len(answers) - 1, len(answers) * p // 100)] for p in (50, 95, 99)}
    return {"answers": len(answers), **of}


def _ask(url: str, jobs: list[str], answers: list[float], stop: threading.Event) -> None:
    with httpx.Client(base_url=url, timeout=60) as client:
        i = 0
        while not stop.wait(ASK_EVERY_S):
            job = jobs[i % len(jobs)]
            path = ("/v1/jobs", f"/v1/jobs/{job}", f"/v1/jobs/{job}/logs")[i % 3]
            begun = time.perf_counter()
            client.get(path).raise_for_status()
            answers.append(time.perf_counter() - begun)
            i += 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("overhead", "storm", "viewers"))
    parser.add_argument("--scan", type=Path, help="default: a made one of 19,600 points and three photographs")
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=200)
    parser.add_argument("--viewers", type=int, default=100)
    parser.add_argument("--points", type=int, default=200_000, help="of the scan that they look at")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.what == "overhead":
        found = overhead(options.scan, options.pairs, options.preset)
    else:
        found = storm(options.jobs) if options.what == "storm" else viewers(options.viewers, options.points)
    if options.json:
        print(json.dumps(found))
        return
    for name, value in found.items():
        if name == "pairs":
            for row in value:
                print("  ".join(f"{key} {seconds:.1f}" for key, seconds in row.items()))
        else:
            print(f"{name}: {value}")


if __name__ == "__main__":
    main()
