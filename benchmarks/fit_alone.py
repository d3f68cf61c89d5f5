"""Fit what one process does alone, and what scheduler, client and workers take around tasks, to the rows of
`benchmarks/alone.py`: see `benchmarks/fit_costs.py --alone`."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from scipy.optimize import nnls

from pipeline.catalogue import BY_NAME, Task
from pipeline.costs.job import Dispatch, StageCost


@dataclass(frozen=True)
class Held:
    """What was measured alone, beside what the fitted terms say."""

    stage: str
    size: str
    measured_s: float
    model_s: float


def fit_alone(rows: list[dict], costs: dict[str, dict]) -> tuple[dict[str, dict], Dispatch, list[Held]]:
    """The costs by stage with terms of one process as measured, what is around tasks, and each row beside its fit."""
    dispatch, begin_s, held = _dispatch([row for row in rows if row["kind"] == "dispatch"])
    for name in sorted({row["name"] for row in rows if row["kind"] == "stage"}):
        of_stage = [row for row in rows if row["kind"] == "stage" and row["name"] == name]
        costs[name], found = _of_stage(name, of_stage, costs[name], begin_s)
        held += found
    for kind, fit in (("pack", _pack), ("cells", _cells), ("training", _training), ("kinds", _kinds)):
        if some := [row for row in rows if row["kind"] == kind]:
            held += fit(some, costs, begin_s)
    return costs, dispatch, held


def _line(y: list[float], *columns: list[float]) -> np.ndarray:
    """Least squares of y = a + b x + c z, each row in proportion, none negative."""
    measured, terms = np.array(y), np.array([np.ones(len(y)), *columns], float).T
    scale = terms.max(axis=0)
    weight = 1 / np.maximum(measured, 0.05 * measured.max() + 1e-12)
    return nnls(terms / scale * weight[:, None], measured * weight)[0] / scale


def _dispatch(rows: list[dict]) -> tuple[Dispatch, float, list[Held]]:
    """By processor seconds of the process of client and scheduler; a worker's are what is left of all."""
    calls, tasks = ([row[k] for row in rows] for k in ("calls", "tasks"))
    begin, call, task = _line([row["processor_s"] for row in rows], calls, tasks)
    around = float(
        np.median(
            [
                (row["seconds"] - begin) * row["workers"] / row["tasks"]
                for row in rows
                if 1 < row["calls"] < row["tasks"]
            ]
        )
    )
    held = [
        Held(
            "calls",
            f"{row['tasks']:,} tasks in {row['calls']:,} calls",
            row["processor_s"],
            begin + call * row["calls"] + task * row["tasks"],
        )
        for row in rows
    ]
    begin_s = float(np.median([row["seconds"] for row in rows if row["tasks"] == 1]))
    return Dispatch(float(call), float(task), around), begin_s, held


def _of_stage(name: str, rows: list[dict], cost: dict, begin_s: float) -> tuple[dict, list[Held]]:
    took, tasks = [row["finalise_s"] + row["hand_over_s"] for row in rows], [row["tasks"] for row in rows]
    once, a_task = _line(took, tasks)
    init_s = float(np.median([row["init_s"] for row in rows]))
    fixed = {"once_s": begin_s + init_s + float(once), "once_us_a_unit": 0.0, "once_s_a_task": float(a_task)}
    if BY_NAME[name].task == Task.BY_PHOTO:
        fixed |= {"once_s": begin_s + init_s + took[0], "once_s_a_task": 0.0}
    held = [Held(name, f"{n:,} tasks", s, float(once + a_task * n)) for n, s in zip(tasks, took)]
    return cost | fixed, held


def _pack(rows: list[dict], costs: dict[str, dict], begin_s: float) -> list[Held]:
    """Laying out by splats, sealing by bytes."""
    splats, laid_out = [row["splats"] for row in rows], [row["lay_out_s"] for row in rows]
    once, a_splat = _line(laid_out, splats)
    sealed = [row for row in rows if "seal_s" in row]
    n_bytes = [row["bytes"] for row in sealed]
    (opening, a_byte), (closing, of_digest) = (
        _line([row[k] for row in sealed], n_bytes) for k in ("written_s", "digest_s")
    )
    init_s, a_splat_bytes = float(np.median([row["init_s"] for row in rows])), costs["pack"]["written_bytes_a_unit"]
    costs["pack"] |= {"once_s": begin_s + init_s + float(once), "once_us_a_unit": 1e6 * float(a_splat)}
    known = costs.get("join") or asdict(StageCost(0.0, 0.0, 0.0, a_splat_bytes, costs["pack"]["memory_bytes"], 0.0))
    costs["join"] = known | {
        "task_us_a_unit": 1e6 * float(a_byte) * a_splat_bytes,
        "once_s": float(opening + closing),
        "once_us_a_unit": 1e6 * float(of_digest) * a_splat_bytes,
    }
    held = [Held("pack, laid out", f"{n:,} splats", s, float(once + a_splat * n)) for n, s in zip(splats, laid_out)]
    for row in sealed:
        n, size = row["bytes"], f"{row['bytes']:,} bytes"
        held += [Held("join, written", size, row["written_s"], float(opening + a_byte * n))]
        held += [Held("join, digest", size, row["digest_s"], float(closing + of_digest * n))]
        held += [Held("join, by one", size, row["seal_s"], float(opening + closing + (a_byte + of_digest) * n))]
    return held


def _cells(rows: list[dict], costs: dict[str, dict], begin_s: float) -> list[Held]:
    held, parts = [], [row["parts"] for row in rows]
    for name, keys in (("grid-counts", ("merge_s", "grow_s", "before_s")), ("leaves", ("runs_s",))):
        took = [sum(row[k] for k in keys) for row in rows]
        once, a_task = _line(took, parts)
        costs[name] |= {"once_s": begin_s + float(once), "once_us_a_unit": 0.0, "once_s_a_task": float(a_task)}
        held += [Held(name, f"{n:,} parts", s, float(once + a_task * n)) for n, s in zip(parts, took)]
    return held


def _training(rows: list[dict], costs: dict[str, dict], _: float) -> list[Held]:
    a_splat = [row["seconds"] / row["splats"] for row in rows]
    costs["training-set"] |= {"task_us_a_splat": 1e6 * float(np.median(a_splat))}
    return []


def _kinds(rows: list[dict], costs: dict[str, dict], begin_s: float) -> list[Held]:
    a_splat = [row["seconds"] / row["splats"] for row in rows]
    known = costs.get("kinds") or asdict(StageCost(0.0, 0.0, 0.0, 0.0, costs["colors"]["memory_bytes"], 0.0))
    costs["kinds"] = known | {"task_us_a_unit": 1e6 * float(np.median(a_splat)), "once_s": begin_s}
    return []
