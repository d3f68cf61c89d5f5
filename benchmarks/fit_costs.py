"""Fit the cost model of `pipeline/costs/costs.py` to runs of `benchmarks/scaling.py`, or check it on runs it has not
seen.

    python -m benchmarks.scaling SCAN --splats 100000 400000 1000000 4000000 --workers 1 --out rows.jsonl
    python -m benchmarks.scaling SCAN --splats 200000 --workers 1 --dictionary-bits 8 --out rows.jsonl
    python -m benchmarks.alone SCAN FOLDER --out alone.jsonl
    python -m benchmarks.fit_costs rows.jsonl --alone alone.jsonl --write           # pipeline/costs/costs.json
    python -m benchmarks.fit_costs others.jsonl --check [--json]

Rows are measured with `--pursuit omp`; what a beam adds is measured by `benchmarks/beam.py`, and kept. Rows with
different numbers of indices tell what each costs. Tasks cost the processor seconds they took: a busy machine
leaves those almost as they are. What one process does besides is what its seconds exceed those of its tasks by, kernels
that each worker loads once among it; where `benchmarks/alone.py` has measured it alone, that counts, and rows may be
none ("-": only what is alone is fitted).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks.fit_alone import fit_alone
from pipeline.catalogue import Task
from pipeline.coding.beam.form import beam_of
from pipeline.costs.costs import (
    BY_ATOMS,
    COSTS,
    SAMPLED,
    TASKS,
    beam_us,
    kilos_of,
    known_costs,
    known_probe_s,
    plan_job,
)
from pipeline.costs.job import Job, StageCost
from storage.work.arrays import BLOCK

PHOTOGRAPHS = {
    "fountain_p11": (11, 1.573),
    "monstree": (12, 1.573),
}  # number, millions of pixels; of other scans: --photographs


FULL = 400_000  # splats
GROWING = {Task.SLICE, Task.PART, Task.BLOCK, Task.GROUP, Task.PHOTO, Task.BY_PHOTO}


def fitted(rows: list[dict]) -> dict[str, StageCost]:
    return {name: _fit(name, rows) for name in TASKS if any(_stage_of(name) in row["tasks"] for row in rows)}


def _fit(name: str, rows: list[dict]) -> StageCost:
    rows = [row for row in rows if _stage_of(name) in row["tasks"]]
    found = [_measured(name, row) for row in rows]
    units, passes, kilos = (np.array([f[k] for f in found]) for k in ("units", "passes", "kilos"))
    by_atoms = name in BY_ATOMS
    once, once_a_unit, once_a_kilo = _sum(
        np.maximum([f["once_s"] for f in found], 0) / passes, units, kilos if by_atoms else None
    )
    a_unit = np.array([f["tasks_s"] / f["looked_at"] for f in found])
    task, task_a_kilo = _line(kilos, a_unit) if by_atoms else (np.median(a_unit), 0.0)
    written = np.array([f["written"] for f in found]) / passes
    _, written_a_unit, written_a_kilo = (
        _sum(written, units, kilos) if by_atoms else (0.0, np.median(written / units), 0.0)
    )
    memory, memory_a_unit = _memory(
        np.array([row["splats"] for row in rows]), units, np.array([f["peak"] for f in found])
    )
    return StageCost(
        *map(
            float,
            (
                1e6 * task,
                once,
                1e6 * once_a_unit,
                written_a_unit,
                memory,
                memory_a_unit,
                1e6 * task_a_kilo,
                once_a_kilo,
                written_a_kilo,
            ),
        )
    )


def tasks_fitted(rows: list[dict], known: dict[str, StageCost]) -> dict[str, dict[str, float]]:
    """Seconds a unit alone, of the stages whose tasks grow with the scan, by rows of one number of indices: what a beam
    and each index cost among them stays in proportion as it is known; and memory, where it is more."""
    found = {}
    for name in (name for name in TASKS if name in known and TASKS[name] in GROWING):
        cost, measured = known[name], [_measured(name, row) for row in rows if _stage_of(name) in row["tasks"]]
        if not measured:
            continue
        kilos = measured[0]["kilos"]
        beam = beam_us(cost, beam_of(rows[0]["pursuit"]), kilos)
        a_unit = 1e6 * float(np.median([f["tasks_s"] / f["looked_at"] for f in measured])) - beam
        share = a_unit / (cost.task_us_a_unit + cost.task_us_a_unit_a_kilo * kilos)
        found[name] = {k: share * getattr(cost, k) for k in ("task_us_a_unit", "task_us_a_unit_a_kilo")}
        found[name]["memory_bytes"] = max(cost.memory_bytes, *(float(f["peak"]) for f in measured))
    return found


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Least squares of y = a + b x with neither negative; a alone where all x are equal."""
    return _sum(np.asarray(y), None, x)[::2]


def _sum(y: np.ndarray, units: np.ndarray | None, kilos: np.ndarray | None) -> tuple[float, float, float]:
    """Least squares, each row in proportion, of y = a + b units + c kilos, none negative; what does not vary has no
    part."""
    from scipy.optimize import nnls

    varies = [x is not None and len(np.unique(x)) > 1 for x in (units, kilos)]
    columns = [np.ones(len(y))] + [x for x, v in zip((units, kilos), varies) if v]
    scale = np.array([x.max() for x in columns])
    weight = 1 / np.maximum(y, 0.05 * y.max() + 1e-12)
    share, _ = nnls(np.stack(columns, axis=1) / scale * weight[:, None], y * weight)
    found = iter(share / scale)
    return next(found), *(next(found) if v else 0.0 for v in varies)


def _memory(splats: np.ndarray, units: np.ndarray, peak: np.ndarray) -> tuple[float, float]:
    """What a worker needs, and how that grows: by scans of FULL splats and more, whose workers have full blocks and a
    heap that has settled. Growth within a tenth is none."""
    full = splats >= FULL
    if len(np.unique(splats[full])) < 2 or peak[full].max() < 1.1 * peak[full].min():
        return float(peak.max()), 0.0
    return _line(units[full], peak[full])


def _stage_of(name: str) -> str:
    return "ingest" if name == "photographs" else name


def _measured(name: str, row: dict) -> dict:
    tasks = row["tasks"][_stage_of(name)]
    processor, splats, wall, compiling = (
        np.array(tasks[k]) for k in ("processor_seconds", "splats", "seconds", "compile_seconds")
    )
    here = np.ones(len(splats), bool)
    if _stage_of(name) == "ingest":
        here = splats == 0 if name == "photographs" else splats > 0
    units = np.prod(_photographs(row)) if TASKS[name] == Task.PHOTO else _rows_of(name, row, splats)
    once = 0.0 if name == "photographs" else row["seconds"][name] - (wall - compiling).sum() / row["workers"]
    return {
        "units": units,
        "passes": tasks["passes"],
        # Of learning and quantising some passes look at a share of the patches.
        "looked_at": splats.sum() if name in ("ksvd-update", "quantise") else units * tasks["passes"],
        "kilos": kilos_of(row["indices"], row["atom_size"]),
        "tasks_s": np.maximum(processor - compiling, 0)[here].sum(),
        "once_s": once,
        "peak": max(np.array(tasks["peak_rss_bytes"])[here], default=0),
        "written": 3e6 * units
        if name == "photographs"
        else max(0.0, tasks["written_bytes"] - _photograph_bytes(name, row)),
    }


def _rows_of(name: str, row: dict, splats: np.ndarray) -> float:
    if TASKS[name] == Task.SAMPLE:
        return float(min(row["splats"], SAMPLED * BLOCK))
    if TASKS[name] in (Task.TRAINING, Task.ONCE):
        learned = row["tasks"].get("coefficients", row["tasks"]["training-set"])
        return float(sum(learned["splats"]))
    return float(row["splats"])


def _of_beams(known: StageCost | None) -> dict[str, float]:
    """What is measured apart."""
    return {name: getattr(known, name) for name in ("task_us_a_unit_a_node_a_kilo", "task_us_a_unit_a_child") if known}


def _photograph_bytes(name: str, row: dict) -> float:
    return 3e6 * np.prod(_photographs(row)) if name == "ingest" else 0.0


def _photographs(row: dict) -> tuple[int, float]:
    return PHOTOGRAPHS[row["scan"]]


def checked(rows: list[dict]) -> list[dict]:
    """Seconds predicted and measured, of all stages of the model that the scan called for together and one by one, on
    the machine of each row; and the stages that the model does not know."""
    result = []
    for row in rows:
        n, megapixels = _photographs(row)
        costs = known_costs(speed=row["probe_s"] / known_probe_s())
        job = Job(
            row["splats"],
            row["workers"],
            n,
            megapixels,
            sum(row["tasks"]["coefficients"]["splats"]),
            row["tasks"]["ksvd-update"]["passes"],
            row["indices"],
            row["atom_size"],
            pursuit=row["pursuit"],
            max_atoms=row["max_atoms"],
            atoms=row["atoms"],
        )
        plans = {p.name: p.seconds for p in plan_job(job, costs)}
        plans["ingest"] += plans.pop("photographs")
        measured = {name: row["seconds"].get(name, 0.0) for name in plans if name in row["seconds"]}
        plans = {name: s for name, s in plans.items() if name in row["seconds"]}
        result.append(
            {
                "scan": row["scan"],
                "splats": row["splats"],
                "workers": row["workers"],
                "predicted_s": sum(plans.values()),
                "measured_s": sum(measured.values()),
                "ratio": sum(plans.values()) / sum(measured.values()),
                "not_modelled": sorted(set(row["seconds"]) - set(TASKS)),
                "stages": {name: [plans[name], measured[name]] for name in plans},
            }
        )
    return result


def write_costs(rows: list[dict], alone: list[dict], tasks_only: bool = False) -> None:
    """pipeline/costs/costs.json anew; what there are no rows of stays, as of maps, volumes and runs."""
    told = json.loads(COSTS.read_text())
    known = known_costs()
    costs = {name: asdict(cost) for name, cost in known.items()}
    if rows and tasks_only:
        for name, terms in tasks_fitted(rows, known).items():
            costs[name] |= terms
        told["fitted_to"] = [
            *dict.fromkeys([*told["fitted_to"], *(f"seconds of tasks: {_about(row)}" for row in rows)])
        ]
    elif rows:
        costs |= {name: asdict(cost) | _of_beams(known.get(name)) for name, cost in fitted(rows).items()}
        told["fitted_to"] = sorted({_about(row) for row in rows})
    if rows:
        told["probe_s"] = float(np.median([row["probe_s"] for row in rows]))
    if alone:
        costs, dispatch, held = fit_alone(alone, costs)
        told |= {"dispatch": asdict(dispatch), "alone": [asdict(one) for one in held]}
    COSTS.write_text(json.dumps(told | {"stages": costs}, indent=1) + "\n")


def _about(row: dict) -> str:
    return (
        f"{row['scan']}, {row['splats']:,} splats, {row['workers']} workers, {row['indices']:,} indices of "
        f"{row['atom_size']}x{row['atom_size']} texels, coder {row['coder']}, pursuit {row['pursuit']}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", type=Path)
    parser.add_argument("--tasks-only", action="store_true", help="of rows, seconds of tasks that grow with the scan")
    parser.add_argument("--alone", type=Path, help="rows of benchmarks/alone.py")
    todo = parser.add_mutually_exclusive_group(required=True)
    todo.add_argument("--write", action="store_true")
    todo.add_argument("--check", action="store_true")
    parser.add_argument(
        "--photographs", nargs=2, type=float, metavar=("N", "MEGAPIXELS"), help="of a scan that is not known"
    )
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = [] if str(options.rows) == "-" else [json.loads(line) for line in options.rows.read_text().splitlines()]
    if options.photographs:
        PHOTOGRAPHS.update({row["scan"]: (int(options.photographs[0]), options.photographs[1]) for row in rows})
    if options.write:
        alone = [json.loads(line) for line in options.alone.read_text().splitlines()] if options.alone else []
        write_costs(rows, alone, options.tasks_only)
        return
    found = checked(rows)
    if options.json:
        print(json.dumps({"rows": found}))
        return
    for row in found:
        print(
            f"{row['scan']}, {row['splats']:,} splats, {row['workers']} workers: {row['predicted_s']:.1f} s predicted, "
            f"{row['measured_s']:.1f} measured, ratio {row['ratio']:.2f}"
        )
        for name, (predicted, measured) in row["stages"].items():
            print(f"    {name:<16} {predicted:7.2f} {measured:7.2f}")


if __name__ == "__main__":
    main()
