"""docs/SCALE.md, made from the cost model: `python -m services.docs.scale` writes it again."""

from __future__ import annotations

import json
from pathlib import Path
from textwrap import fill

from pipeline.costs.costs import COSTS
from pipeline.planning.settings import Settings
from services.processes.plan import as_text, plan

PATH = Path(__file__).resolve().parents[2] / "docs" / "SCALE.md"
PHOTOGRAPHS, MEGAPIXELS = 441, 9.0  # the paper's larger scan
STATIONS = 31
_HEAD = """# How far it scales, and what breaks first

Made from `pipeline/costs/costs.json` by `python -m services.docs.scale`. `splatpress plan --splats 71e6 --workers 24`
prints such a plan for any size; `--json` has every figure of it.

## The model

A stage costs what its tasks take on the workers, dealt out by one scheduler that spends some on each call and each task
(simulated, `pipeline/costs/costs.py`), and what one process does before and after them. Seconds a splat and an index,
bytes and memory are fitted by `benchmarks/fit_costs.py` to the rows below; tasks count by their processor seconds.

{fitted}

They are measured and fitted again, and held against runs outside the fit, by

    python -m benchmarks.scaling SCAN --splats 100000 400000 1000000 4000000 --workers 1 --out rows.jsonl
    python -m benchmarks.scaling SCAN --splats 200000 --workers 1 --dictionary-bits 8 --out rows.jsonl
    python -m benchmarks.alone SCAN FOLDER --out alone.jsonl
    python -m benchmarks.fit_costs rows.jsonl --alone alone.jsonl --write && python -m services.docs.scale
    python -m benchmarks.scaling ANOTHER --workers 2 --out others.jsonl
    python -m benchmarks.fit_costs others.jsonl --check     # a run outside the fit: predicted beside measured

`benchmarks.fit_costs - --alone alone.jsonl --write` fits what one process does alone, and what is around tasks, and
leaves all else. What one process does alone is measured alone, on what so many tasks would leave: `init` and `finalise`
of every stage whose tasks grow with the scan, on copies of what tasks of a small job told, pickled as Dask hands them
over; the table, the directory and the seal of a packed file; the counts of a grid; scheduler and client, by tasks that
do nothing. Measured, and what the fitted terms say of the same:

{alone}

Bytes are those of the arrays that a stage reads, each once: what several of its tasks ask for comes from the disk
cache, or is read again. `python -m benchmarks.bytes_moved SCAN` counts all that tasks ask for: of `fountain_p11`
(draft) 3,418 bytes a splat, 1,276 of them parts of pictures of nearest points as they are unpacked and 430 points that
all 11 cameras look through, where they were 15,600 with these pictures read as they are; 668 are written, where they
were 1,160.

What it does not know: a network store slower than a local disk (the bytes read and written are there to compare with
one's own), how many atoms patches take (`--atoms-a-splat`; 1.73 where nothing is said), ellipsoids, pictures, coarser
levels (a third more of all from `splats` on, where a scan has them), more photographs that a splat may be textured from
than 11, leaves that every part of the file has points of (4,096 files to open), a worker that dies. Nor the report: of
a file of more than 512 groups it is made of 512 of them and of the totals, but whoever opens a file lists its members,
12 for 8,192 splats, which of 10 billion are 15 million. A short piece of work like that of the stages
(`pipeline/costs/probe.py`) tells how fast a machine is beside the one that the costs were measured on; `plan` scales
seconds by that, this page and `--as-measured` do not.

## What is done about size

- **Reading and ordering are dealt out.** A task reads a slice of the file: rows of a binary PLY, points of a LAS,
  chunks of a LAZ, packets of an E57, a COLMAP workspace with its visibility lists (`read_slice` of a scan). Points are
  counted per cell of a grid, cells are merged to leaves of about a million points, every task deals out its part of the
  file to them, and every leaf is split by itself (`pipeline/geometry/leaves.py`); the order is one, whatever the number
  of tasks. What is read from its start alone is one task: a text PLY and what lies in a .zip.
- **Memory of a worker does not grow with the scan.** A task holds a block of 16,384 splats, a slice or a leaf; a leaf
  that one place fills with more than fits is split on disk (`stages/points/split_on_disk.py`); sums of a dictionary are
  as large as the dictionary, lie in its principal components (64 to 1,024 values an atom, not 3,072), and are merged
  4,096 atoms at a time, so that 65,536 atoms learn within 4 GiB.
- **Learning does not grow with the scan**: its training set is a number, not a share, and only its rows are read.
- **The scheduler is kept ahead** by calls of up to 32 tasks where a stage has many (`pipeline/execution/executors.py`).
  Nothing is scattered: a task opens what it reads; a process keeps the dictionary that it read last.
- **The packed file is written by all workers.** A task writes its groups as they will stand in the file, headers of
  the zip and all, so that its length is all that the others need to know; the table and the directory are laid out from
  what tasks told, 4,096 groups at a time. Above 4 GiB all workers write ranges of one file (`stages/packed/join.py`);
  what is left to one process is to read it once for its seal, a SHA-256 of all bytes in their order. Smaller files are
  put together by one process in one pass. The bytes are the same.
- **What one process does alone** is what ends scaling first: results are gathered, and stages begun and ended, by one.
  What tasks share lies in arrays that they map, not in a summary that each parses: boxes of blocks, of 10 billion 29
  MB.
- **The scheduler is what holds up a thousand workers**: calls of tens of milliseconds end faster than one process hands
  them out, however few it is spent on.
"""


def document() -> str:
    """The text of docs/SCALE.md."""
    told = json.loads(COSTS.read_text())
    fitted = "\n".join(fill(row, 120, initial_indent="- ", subsequent_indent="  ") for row in told["fitted_to"])
    parts = [_HEAD.format(fitted=fitted, alone=_held(told["alone"]))]
    photographs = f"{PHOTOGRAPHS} photographs of {MEGAPIXELS:g} million pixels"
    for title, splats, workers, n_stations in (
        (f"71 million splats, as the paper's scan, {photographs}", 71_000_000, 24, 0),
        (f"3.5 billion splats of {STATIONS} stations, textured from their maps", 3_500_000_000, 100, STATIONS),
        (f"10 billion splats, {photographs}", 10_000_000_000, 1000, 0),
    ):
        found = plan(splats, workers, Settings(), PHOTOGRAPHS, MEGAPIXELS, n_stations=n_stations)
        alone = f"    of it one process alone: {100 * found['alone_share']:.1f} %\n"
        parts.append(f"\n## {title}\n\n" + alone + _indented(as_text(found)))
    return "".join(parts)


def _held(rows: list[dict]) -> str:
    lines = [f"    {'':<18}{'of':<34}{'measured':>10}{'model':>10}"]
    lines += [f"    {r['stage']:<18}{r['size']:<34}{r['measured_s']:>9.3f}s{r['model_s']:>9.3f}s" for r in rows]
    return "\n".join(lines)


def _indented(text: str) -> str:
    return "".join(f"    {line}".rstrip() + "\n" for line in text.splitlines())


if __name__ == "__main__":
    PATH.write_text(document())
