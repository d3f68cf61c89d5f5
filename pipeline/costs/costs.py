"""What a job of any size costs, stage by stage, from what small ones cost: arithmetic, and a simulated scheduler.

`costs.json` is measured and fitted by `benchmarks/fit_costs.py`. A stage's time is what its tasks take on the workers,
dealt out by a scheduler that spends some on each call and task, and what it does before and after them in one process; where
atoms are searched, both grow with the number of their indices. Seconds are those of the machine that they were measured
on, times what `pipeline/costs/probe.py` says of another. A store shared by many machines counts as fast as a local disk.
"""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace
from pathlib import Path
from typing import NamedTuple

from pipeline.catalogue import CATALOGUE, Phase, Task
from pipeline.coding.beam.form import Beam, beam_of
from pipeline.coding.ksvd import BLOCK as TRAINING_BLOCK
from pipeline.coding.passes import learning_pursuit, quantised_share, rounds_of_passes
from pipeline.costs.job import ATOMS, KILO, SMALLEST, Dispatch, Job, StageCost, StagePlan
from pipeline.costs.makespan import makespan
from pipeline.costs.of_maps import told_by_stations
from pipeline.execution.executors import MOST_A_CALL, calls_of
from pipeline.execution.task import CALL_S
from pipeline.stages.packed.join import LARGE, RANGE
from pipeline.stages.packed.pack import AT_ONCE
from pipeline.stages.points.grid_counts import IN_MEMORY as MOST_HELD  # units that any stage has in memory at once
from pipeline.stages.points.ingest import MOST_SLICES, SLICE
from pipeline.stages.points.kept import MOST_PARTS, PART
from pipeline.stages.texture.multipliers import LADDER, is_wide
from pipeline.stages.texture.training import held_share
from pipeline.texture.resample import PATCH_DIM
from storage.packed.levels import FEWER
from storage.packed.schema import GROUP
from storage.packed.writing.writer import MOST_PIECES
from storage.work.arrays import BLOCK

CROWDED = 1.10  # times as long that a task takes beside another: two processes took 2.88 s for 5.26 s one by one
SAMPLED = 16  # blocks that effects are measured on
MEASURED = 16  # bytes a splat of what is said of a patch: average, energy
FILE_BYTES = 11  # of a packed file, a splat, about
COSTS = Path(__file__).with_name("costs.json")

PAGES = "photo-pages"
PHOTOGRAPHS = "photographs"  # the part of ingest that grows with them: a stage of its own to the model


def _modelled() -> dict[str, Task]:
    """What a task is, by stage, in the order of the catalogue."""
    tasks: dict[str, Task] = {}
    for entry in CATALOGUE:
        # A plan is told how many points are kept, and of which iso values.
        if entry.phase != Phase.EVALUATION and entry.name not in ("thin", "iso-values"):
            tasks[entry.name] = entry.task
        if entry.name == "ingest":
            tasks[PHOTOGRAPHS] = Task.PHOTO
    return tasks


TASKS = _modelled()
RUNS = {entry.name for entry in CATALOGUE if entry.when == "geometry runs"}
VOLUMES = {name for name, task in TASKS.items() if task in (Task.VOLUME, Task.SLICES)}
TEXTURE = {entry.name for entry in CATALOGUE if entry.phase in (Phase.TEXTURE, Phase.LEARNING)}
OF_SCANS = TEXTURE | {"ingest", PHOTOGRAPHS, "exposure"}
OF_CELLS = set(list(TASKS)[list(TASKS).index("run-points") :])  # stages that know the cells of runs for the points
CELLS_A_POINT = 0.67  # of a scan at the usual hit rate of 1.6, with 7 % that close gaps; of a volume all
VOXELS_A_TASK, BRICK = 1 << 23, 1 << 20  # of iso-surface, about; points of pipeline/geometry/runs/bricks.py
LEARNING = ("dictionary-seed", "ksvd-update")
BEYOND_MEMORY = {entry.name for entry in CATALOGUE if entry.task == Task.PART and entry.when}
BY_ATOMS = {entry.name for entry in CATALOGUE if entry.by_atoms}  # whose costs go with the number of indices
READS = {entry.name: entry.reads for entry in CATALOGUE} | {  # the training set reads its own share of patches
    "splats": ("partition", "neighbours", "sizes"),
    "exposure": (),  # fields of gains: photographs are brought to one light where they are looked at
    "resample": ("splats", PHOTOGRAPHS),
    "colors": ("resample",),
    "training-set": ("colors", "partition"),
    "encode": ("colors", "resample"),
    "kinds": ("encode", "cliplines"),
    "pack": ("splats", "colors", "encode", "cliplines"),
    PAGES: (PHOTOGRAPHS,),
}
# Bytes a splat that a stage reads of another's arrays: positions 24 (of the ingest of files in float32 12), cameras 16,
# normals 12, numbers 8, spacings 4, colours 3.
PARTLY_READ = {
    ("grid-counts", "ingest"): 12,
    ("neighbours", "partition"): 36,
    ("sizes", "partition"): 24,
    ("sizes", "neighbours"): 16,
    ("splats", "partition"): 43,
    ("splats", "neighbours"): 12,
    ("nearest-points", "partition"): 40,
    ("training-set", "colors"): 8,
    ("training-set", "partition"): 8,
    ("encode", "colors"): 4,
    ("encode", "resample"): 0,
    ("kinds", "encode"): 1,
    ("kinds", "cliplines"): 1,
    ("pack", "colors"): 4,
    ("pack", "encode"): 25,
}
# Of photographs, for each of five training patches of a block (`fountain_p11`): they are not read whole.
LONE_PATCH_BYTES = 13_900


def known_costs(path: Path = COSTS, speed: float = 1.0) -> dict[str, StageCost]:
    """The fitted costs by stage, on a machine that takes `speed` times as long."""
    costs = {name: StageCost(**row) for name, row in json.loads(path.read_text())["stages"].items()}
    return {
        name: replace(
            cost, **{f.name: speed * getattr(cost, f.name) for f in fields(cost) if "_s" in f.name or "_us" in f.name}
        )
        for name, cost in costs.items()
    }


def kilos_of(n_indices: int, atom_size: int) -> float:
    """The unit of `StageCost`."""
    return n_indices / KILO * (atom_size / SMALLEST) ** 2


def known_probe_s(path: Path = COSTS) -> float:
    """What the probe took on the machine that the costs were measured on."""
    return json.loads(path.read_text())["probe_s"]


def known_dispatch(path: Path = COSTS, speed: float = 1.0) -> Dispatch:
    """What scheduler, client and workers take around tasks, on a machine that takes `speed` times as long."""
    return Dispatch(**{name: speed * s for name, s in json.loads(path.read_text())["dispatch"].items()})


def plan_job(job: Job, costs: dict[str, StageCost], dispatch: Dispatch | None = None) -> list[StagePlan]:
    """Every stage of a job, in order."""
    dispatch = dispatch or known_dispatch()
    kilos = kilos_of(job.n_indices, job.atom_size)
    called_for = {name: costs[name] for name in TASKS if name in costs and _is_called_for(name, job)}
    written = {
        name: cost.written_bytes_a_unit * _units(name, job) + cost.written_bytes_a_kilo * kilos
        for name, cost in called_for.items()
    }
    if not job.keeps_patches and "resample" in written:
        written["resample"] = float(MEASURED) * job.n_splats
    known = _Known(job, kilos, written, dispatch, called_for.get("encode"))
    return [_plan_stage(name, cost, known) for name, cost in called_for.items()]


class _Known(NamedTuple):
    """What the plans of all stages of a job are made from."""

    job: Job
    kilos: float
    written: dict[str, float]  # bytes, by stage
    dispatch: Dispatch
    encode: StageCost | None  # whose search others do too


def _is_called_for(name: str, job: Job) -> bool:
    if (told := told_by_stations(name, job.n_stations)) is not None:
        return told
    if name in VOLUMES or name in OF_SCANS:
        return (name in VOLUMES) == bool(job.n_voxels)
    if name in LEARNING and not job.learns:
        return False
    is_large = name not in BEYOND_MEMORY or job.n_splats > MOST_HELD
    return (
        is_large and (name != PAGES or job.pages and not job.n_voxels) and (name not in RUNS or job.geometry == "runs")
    )


def _plan_stage(name: str, cost: StageCost, known: _Known) -> StagePlan:
    rounds = [
        (_plan_once(name, cost, known._replace(job=replace(known.job, pursuit=pursuit)), share), n)
        for share, n, pursuit in _rounds(name, known.job)
    ]
    summed = ("n_tasks", "seconds", "once_s", "dispatch_s", "read_bytes", "written_bytes")
    return replace(rounds[-1][0], **{key: sum(n * getattr(plan, key) for plan, n in rounds) for key in summed})


def _rounds(name: str, job: Job) -> tuple[tuple[float, int, str], ...]:
    """How often a stage runs, over which share of its units, and by which pursuit: levels of weights are first those
    for learning, then those for the last passes, then those for the Lagrange multiplier that was found."""
    n_units, learning = int(_units(name, job)), learning_pursuit(job.pursuit)
    if name == "ksvd-update":
        first, *last = rounds_of_passes(job.iterations, n_units)
        return (*first, "omp"), *((*found, learning) for found in last)
    if name == "multipliers":
        return (1.0, 1, learning), (1.0, 1, job.pursuit)
    return ((quantised_share(n_units), 3, job.pursuit),) if name == "quantise" else ((1.0, 1, job.pursuit),)


def _plan_once(name: str, cost: StageCost, known: _Known, share: float) -> StagePlan:
    """A stage that runs once, over a share of its units."""
    job, kilos, written, dispatch, _ = known
    units, n_tasks = share * _units(name, job), math.ceil(share * _n_tasks(name, job))
    task_s = cost.task_s + 1e-6 * (cost.task_us_a_unit + _search_us(name, cost, known)) * units / max(1, n_tasks)
    task_s += dispatch.around_s + 1e-6 * cost.task_us_a_splat * job.n_splats / max(1, n_tasks)
    task_s *= CROWDED if min(n_tasks, job.n_workers) > 1 else 1.0
    once_s = (
        cost.once_s + 1e-6 * cost.once_us_a_unit * units + cost.once_s_a_kilo * kilos + cost.once_s_a_task * n_tasks
    )
    calls = calls_of(n_tasks, job.n_workers)
    most = max(1, int(CALL_S / task_s)) if task_s else MOST_A_CALL  # then a call hands the others back
    n_calls = sum(-(-size // most) for size in calls)
    dispatch_s = dispatch.call_s * n_calls / max(1, n_tasks) + dispatch.task_s
    busy_s = makespan(n_tasks, task_s, job.n_workers, dispatch_s)
    return StagePlan(
        name,
        n_tasks,
        min(most, max(calls, default=1)),
        task_s,
        once_s + busy_s,
        once_s,
        n_tasks * dispatch_s,
        share * _read(name, job, written),
        written[name],
        cost.memory_bytes + cost.memory_bytes_a_unit * min(units, MOST_HELD),
    )


def _read(name: str, job: Job, written: dict[str, float]) -> float:
    """Bytes that a pass of a stage reads, what several of its tasks read counted once."""

    def of(stage: str) -> float:
        parts = {source: PARTLY_READ.get((stage, source)) for source in READS.get(stage, ()) if source in written}
        return sum(written[s] if part is None else part * job.n_splats for s, part in parts.items())

    if name == "partition" and "leaves" in written:
        return written["leaves"]
    if name == "training-set":
        windows = min(written.get(PHOTOGRAPHS, 0.0), LONE_PATCH_BYTES * _units(name, job)) + written.get("splats", 0.0)
        return of(name) + (written[name] if job.keeps_patches else windows)
    if name == "encode":
        return of(name) + (PATCH_DIM * job.n_splats if job.keeps_patches else of("resample"))
    return of(name)


def _search_us(name: str, cost: StageCost, known: _Known) -> float:
    """What searching atoms adds to each unit: in proportion to the atoms that a splat takes. A beam that is wide codes
    held patches at every multiplier, at which these take half as many as they may on average."""
    job, kilos, beam = known.job, known.kilos, beam_of(known.job.pursuit)
    searched = cost.task_us_a_unit_a_kilo * kilos + beam_us(cost, beam, kilos)
    if name == "multipliers" and known.encode and is_wide(job.pursuit):
        of_encode = known.encode.task_us_a_unit_a_kilo * kilos + beam_us(known.encode, beam, kilos)
        return len(LADDER) * held_share(int(_units(name, job))) * job.max_atoms / 2 / ATOMS * of_encode
    return searched * (job.atoms / ATOMS if name == "encode" else 1.0)


def beam_us(cost: StageCost, beam: Beam | None, kilos: float) -> float:
    """What a beam adds to each unit."""
    if beam is None:
        return 0.0
    return beam.width * (cost.task_us_a_unit_a_node_a_kilo * kilos + cost.task_us_a_unit_a_child * beam.candidates)


def _units(name: str, job: Job) -> float:
    kind = TASKS[name]
    if name in VOLUMES:
        return job.n_voxels
    if kind == Task.PHOTO:
        return job.n_photographs * job.megapixels
    if name == "run-grid":
        return job.n_splats
    if name in OF_CELLS and job.geometry == "runs" and not job.n_voxels:
        job = replace(job, n_splats=round(CELLS_A_POINT * job.n_splats), geometry="boxes")
    if kind == Task.STATION and not job.n_stations:
        return 0
    if kind == Task.SAMPLE:
        return min(job.n_splats, SAMPLED * BLOCK)
    return min(job.training_splats, job.n_splats) if kind in (Task.TRAINING, Task.ONCE) else job.n_splats


def _n_tasks(name: str, job: Job) -> int:
    kind = TASKS[name]
    if kind in (Task.PHOTO, Task.BY_PHOTO):
        return job.n_photographs
    if kind == Task.STATION:
        return job.n_stations
    rows = {
        Task.SLICE: max(SLICE, job.n_splats // MOST_SLICES),
        Task.PART: max(PART, job.n_splats // MOST_PARTS) if name in BEYOND_MEMORY else MOST_HELD,
        Task.BLOCK: BLOCK,
        Task.BRICK: BRICK,
        Task.SLICES: VOXELS_A_TASK,
        Task.SAMPLE: BLOCK,
        Task.GROUP: AT_ONCE * max(1, -(-job.n_splats // (AT_ONCE * MOST_PIECES))),
        Task.RANGE: RANGE // FILE_BYTES if FILE_BYTES * job.n_splats > LARGE else job.n_splats,
        Task.POINTS_OF_GROUP: FEWER * GROUP,
        Task.TRAINING: TRAINING_BLOCK,
    }.get(kind)
    return 1 if rows is None else max(1, -(-int(_units(name, job)) // rows))
