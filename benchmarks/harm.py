"""A corpus of harm: mutated inputs of every format, each of which must end soon, in one line, and leave nothing behind.

    python benchmarks/harm.py [--n 10000] [--seed 0] [--workers 2] [--worst 20]

Each mutant is a small made file (or a packed file) with bytes flipped, cut, doubled, swapped, zeroed, or with a number
made huge. `check` and, for photographs, decoding run on it in a process of their own. It must end within SECONDS and
MEMORY_BYTES with exit 0, 3 or 5, with at most one line of error, and leave no file behind. Prints what did not, and the
worst in time and memory.
"""

from __future__ import annotations

import argparse
import io
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

SECONDS = 10.0
MEMORY_BYTES = 1 << 30
FINE = (0, 3, 5)
HUGE = (0xFF, 0x7F, 0x80)
TUS_HEADERS = {  # all that a request of the protocol may say, so that each of them is mutated
    "tus-resumable": "1.0.0",
    "upload-length": "123456",
    "upload-offset": "0",
    "upload-metadata": "filename c2Nhbi5wbHk=,sha256 YWJj",
    "upload-checksum": "sha256 YWJjZGVmZ2hpamtsbW5vcHFyc3R1dnd4eXo=",
    "upload-concat": "final;/v1/uploads/0123456789abcdef /v1/uploads/fedcba9876543210",
    "content-type": "application/offset+octet-stream",
}


# --- what is mutated ---


def originals(folder: Path) -> list[Path]:
    """One small valid input of each kind."""
    import laspy

    from tests.pipeline.readers import test_e57 as e57
    from tests.pipeline.readers import test_formats as formats
    from tests.pipeline.readers.workspace import write_workspace, zip_folder

    made = write_workspace(folder / "bin", photo_suffix=".jpg")
    write_workspace(folder / "txt", ending=".txt")
    files = [made.path / "fused.ply", zip_folder(made.path, folder / "w.zip")]
    for suffix, point_format, version in ((".las", 3, "1.2"), (".laz", 3, "1.2"), (".laz", 7, "1.4")):
        scan = laspy.LasData(laspy.LasHeader(point_format=point_format, version=version))
        scan.x, scan.y, scan.z = np.random.default_rng(0).random((3, 3000))
        scan.red = scan.green = scan.blue = np.arange(3000) * 20
        files.append(folder / f"{point_format}{suffix}")
        scan.write(str(files[-1]))
    colored = e57.cartesian(500) | {c: np.arange(500) % 256 for c in e57.COLOR}
    files.append(
        e57.write(folder / "a.e57", colored | {"pose": e57.pose_of((1, 0, 0, 0), (1, 2, 3))}, e57.cartesian(50))
    )
    position, color, normal = formats.points(300)
    for data in ("ascii", "binary", "binary_compressed"):
        files.append(formats.write_pcd(folder / f"{data}.pcd", position, color, data))
    (folder / "a.ptx").write_text(formats.ptx_block(position, color))
    files += [folder / "a.ptx", formats.write_text(folder / "a.xyz", position, color, normal)]
    text = (
        "ply\nformat ascii 1.0\nelement vertex 300\n" + "".join(f"property float {c}\n" for c in "xyz") + "end_header\n"
    )
    files.append(formats.write_text(folder / "ascii.ply", position, header=text))
    packed = folder / "packed.splatpress"
    packed.write_bytes((ROOT / "tests" / "golden" / "color-boxes.splatpress").read_bytes())
    files.append(packed)
    inside = ["fused.ply.vis", "sparse/cameras.bin", "sparse/images.bin", "images/0000.jpg"]
    files += [folder / "bin" / name for name in inside]
    files += [folder / "txt" / name for name in ("sparse/cameras.txt", "sparse/images.txt", "images/0000.png")]
    (folder / "a.tus").write_text("\n".join(f"{name}: {value}" for name, value in TUS_HEADERS.items()))
    files.append(folder / "a.tus")
    return files


def mutated(content: bytes, random: np.random.Generator) -> bytes:
    """One to three changes at places that are more often near the beginning, where counts stand."""
    data = bytearray(content)
    for _ in range(random.integers(1, 4)):
        n = len(data)
        if n < 16:
            break
        at = int(n * random.random() ** (3 if random.random() < 0.5 else 1))
        kind = random.integers(0, 8)
        size = int(random.integers(1, 65))
        if kind == 0:
            data[at] ^= 1 << random.integers(0, 8)
        elif kind == 1:
            del data[at + 1 :]
        elif kind == 2:
            data[at:at] = data[at : at + size]
        elif kind == 3:
            other = int(random.integers(0, n))
            size = min(size, n - max(at, other))
            data[at : at + size], data[other : other + size] = data[other : other + size], data[at : at + size]
        elif kind == 4:
            data[at : at + size] = bytes(len(data[at : at + size]))
        elif kind == 5:
            for i in range(at, min(n, at + int(random.choice((2, 4, 8))))):
                data[i] = HUGE[0] if i else HUGE[1]
        elif kind == 6:
            data[at : at + size] = random.bytes(len(data[at : at + size]))
        else:
            del data[at : at + size]
    return bytes(data)


def whole_input(original: Path, content: bytes, folder: Path) -> Path:
    """The path to give to a command: the mutant, or a workspace that has it in place of its own."""
    import shutil

    parts = original.parts
    root = next((i for i, part in enumerate(parts) if part in ("bin", "txt")), None)
    if root is None or original.name == "fused.ply":
        (folder / original.name).write_bytes(content)
        return folder / original.name
    shutil.copytree(Path(*parts[: root + 1]), folder / "scan")
    (folder / "scan").joinpath(*parts[root + 1 :]).write_bytes(content)
    return folder / "scan"


# --- one mutant ---


@dataclass(frozen=True)
class Outcome:
    name: str
    seconds: float
    memory_bytes: int
    code: int
    said: str
    left: tuple[str, ...]

    @property
    def wrong(self) -> str:
        """What must not be; "" where all is well."""
        if self.code not in FINE:
            return f"exit {self.code}"
        if "Traceback" in self.said or self.said.count("\n") > 1:
            return "more than a line"
        if self.seconds > SECONDS:
            return f"{self.seconds:.1f} s"
        if self.memory_bytes > MEMORY_BYTES:
            return f"{self.memory_bytes >> 20} MiB"
        return f"left {self.left}" if self.left else ""


def ask_tus(lines: bytes) -> None:
    """All that is read out of the headers of a request, as a server hands them over. Raises Problem."""
    from starlette.requests import Request

    from services.uploads import tus

    pairs = (line.partition(b":") for line in lines.split(b"\n"))
    headers = [(name.strip().lower(), value.strip()) for name, _, value in pairs]
    request = Request(
        {"type": "http", "method": "POST", "path": "/v1/uploads", "query_string": b"", "headers": headers}
    )
    tus.check_version(request)
    tus.length_of(request)
    tus.number(request, "upload-offset")
    tus.metadata(request.headers.get("upload-metadata", ""))
    tus.checksum(request)
    tus.concat(request)


def answer(path: str) -> tuple[int, str]:
    """Exit code and error of `check`, and of decoding what it found."""
    from pipeline.readers import open_scan
    from pipeline.readers.check import check_scan
    from services.problems import Problem
    from storage.errors import SplatpressError
    from storage.packed.packed import PackedFile

    try:
        if path.endswith(".tus"):
            ask_tus(Path(path).read_bytes())
            return 0, ""
        if path.endswith(".splatpress"):
            with PackedFile(Path(path)) as packed:
                packed.load()
            return 0, ""
        findings = check_scan(path)
        if any(f.severity == "error" for f in findings):
            return 3, ""
        source = open_scan(path)
        for i in range(len(source.cameras)):
            source.read_photo(i)
        return 0, ""
    except Problem as problem:
        return 3 if problem.status < 500 else 4, f"{problem.detail}\n"
    except SplatpressError as error:
        return error.exit_code, f"{error}\n"
    except FileNotFoundError as error:
        return 2, f"{error}\n"
    except BaseException:
        import traceback

        return 4, traceback.format_exc()


def serve() -> None:
    """Answer the paths on stdin, so that imports are paid for once; a mutant that ends this process is seen by its
    parent."""
    from pipeline.execution.task import peak_rss_bytes

    for line in sys.stdin:
        path, temporary = line.rstrip("\n").split("\t")
        tempfile.tempdir = temporary
        code, said = answer(path)
        peak = peak_rss_bytes()  # not getrusage's, which counts what the parent held when it forked
        print(f"{code}\t{peak}\t{said!r}", flush=True)


class Server:
    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        command = [sys.executable, __file__, "--serve"]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=ROOT
        )

    def ask(self, name: str, path: Path, temporary: Path) -> Outcome:
        begun = time.perf_counter()
        self.process.stdin.write(f"{path}\t{temporary}\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        seconds = time.perf_counter() - begun
        left = tuple(p.name for p in temporary.iterdir())
        if not line:
            code = self.process.wait()
            self._start()
            return Outcome(name, seconds, 0, code, "the process ended", left)
        code, peak, said = line.rstrip("\n").split("\t", 2)
        return Outcome(name, seconds, int(peak), int(code), eval(said), left)

    def end(self) -> None:
        self.process.stdin.close()
        self.process.wait()


def run(n: int, seed: int, n_workers: int, report: io.TextIOBase = sys.stdout) -> list[Outcome]:
    """`n` mutants, dealt to `n_workers` processes; the same for the same seed."""
    with tempfile.TemporaryDirectory() as scratch:
        files = originals(Path(scratch))
        contents = [f.read_bytes() for f in files]

        def share(worker: int) -> list[Outcome]:
            server, found = Server(), []
            for i in range(worker, n, n_workers):
                random, k = np.random.default_rng([seed, i]), i % len(files)
                with tempfile.TemporaryDirectory(dir=scratch) as folder:
                    temporary = Path(folder) / "temporary"
                    temporary.mkdir()
                    (Path(folder) / "in").mkdir()
                    path = whole_input(files[k], mutated(contents[k], random), Path(folder) / "in")
                    found.append(server.ask(f"{i} {files[k].relative_to(scratch)}", path, temporary))
            server.end()
            return found

        with ThreadPoolExecutor(n_workers) as pool:
            return [outcome for part in pool.map(share, range(n_workers)) for outcome in part]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--worst", type=int, default=20)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve()
        return
    outcomes = run(options.n, options.seed, options.workers)
    wrong = [o for o in outcomes if o.wrong]
    codes = {code: sum(o.code == code for o in outcomes) for code in sorted({o.code for o in outcomes})}
    print(f"{len(outcomes) - len(wrong)} of {len(outcomes)} end well; by exit code {codes}")
    for o in wrong:
        print(f"WRONG {o.name}: {o.wrong}: {o.said[-400:]}")
    print("longest:")
    for o in sorted(outcomes, key=lambda o: -o.seconds)[: options.worst]:
        print(f"  {o.seconds:6.2f} s  {o.name}")
    print("most memory of a process that serves many, when it ended:")
    for o in sorted(outcomes, key=lambda o: -o.memory_bytes)[: options.worst]:
        print(f"  {o.memory_bytes >> 20:6} MiB  {o.name}")


if __name__ == "__main__":
    main()
