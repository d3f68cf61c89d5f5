"""`splatpress plan`: what a job of any size costs on any number of workers, and what would hold it back first."""

from __future__ import annotations

from dataclasses import asdict, replace

from pipeline.catalogue import Task
from pipeline.coding.grid import SYMMETRIES, AtomForm
from pipeline.costs.costs import TASKS, known_costs, known_dispatch, known_probe_s, plan_job
from pipeline.costs.job import ATOMS, Dispatch, Job, StageCost, StagePlan
from pipeline.costs.limits import first_limit
from pipeline.effects.shipped_dictionary import takes_shipped
from pipeline.planning.dictionary_size import index_bits
from pipeline.planning.settings import Settings
from renderer.report.report_words import duration, size
from services.flow.textures import SHIPPED_FORM
from storage.packed.dictionaries.shipped import N_ATOMS
from storage.packed.schema import ATOM_SIZES, PATCH_SIZE

LADDER = (1, 2, 5, 10, 24, 50, 100, 200, 500, 1000)  # workers beside those asked for
MEMORY_BYTES = 4 << 30  # what a worker gets


def plan(
    n_splats: int,
    n_workers: int,
    settings: Settings,
    n_photographs: int,
    megapixels: float,
    speed: float = 1.0,
    pages: bool = False,
    n_voxels: int = 0,
    n_stations: int = 0,
    atoms: float = ATOMS,
) -> dict:
    """The plan as the command prints it with --json, for a machine that takes `speed` times as long as the one measured
    on; of a laser scan of so many stations with their maps as texture, in place of photographs; of a scan whose splats
    take so many atoms on average."""
    learns = not (n_photographs and not n_stations and takes_shipped(settings, n_splats))
    form = _likely_form(settings) if learns else SHIPPED_FORM
    n_indices = 2 ** index_bits(settings, form, n_splats) if learns else N_ATOMS * SHIPPED_FORM.n_turns
    job = Job(
        n_splats,
        n_workers,
        0 if n_stations else n_photographs,
        megapixels,
        settings.training_splats,
        settings.iterations,
        n_indices,
        form.size if form else PATCH_SIZE,
        pursuit=settings.pursuit if form else "omp",
        max_atoms=settings.max_atoms,
        atoms=min(atoms, settings.max_atoms),
        pages=pages,
        geometry=settings.geometry,
        learns=learns,
        n_voxels=n_voxels,
        n_stations=n_stations,
    )
    costs, dispatch = known_costs(speed=speed), known_dispatch(speed=speed)
    stages = plan_job(job, costs, dispatch)
    limit, remedy = first_limit(job, stages, MEMORY_BYTES)
    ladder = [_rung(replace(job, n_workers=n), costs, dispatch) for n in sorted({*LADDER, n_workers})]
    return {
        "job": asdict(job),
        "speed": speed,
        **_totals(stages),
        "breaks_first": limit,
        "remedy": remedy,
        "stages": [asdict(s) for s in stages],
        "workers": ladder,
    }


def speed_of_this_machine() -> float:
    """How many times as long as the machine that the costs were measured on it takes."""
    from pipeline.costs.probe import probe_seconds  # compiles kernels

    return probe_seconds() / known_probe_s()


def _likely_form(settings: Settings) -> AtomForm | None:
    """The atoms of a scan that is like those the costs were measured on."""
    if settings.coder == "paper":
        return None
    return AtomForm(min(ATOM_SIZES) if settings.atom_size == "auto" else int(settings.atom_size), SYMMETRIES)


def _rung(job: Job, costs: dict[str, StageCost], dispatch: Dispatch) -> dict:
    stages = plan_job(job, costs, dispatch)
    return {
        "workers": job.n_workers,
        "tasks_a_call": max(s.tasks_a_call for s in stages),
        **_totals(stages),
        "breaks_first": first_limit(job, stages, MEMORY_BYTES)[0],
    }


def _totals(stages: list[StagePlan]) -> dict:
    seconds = sum(s.seconds for s in stages)
    return {
        "seconds": seconds,
        "tasks": sum(s.n_tasks for s in stages),
        "scheduler_share": max(
            (s.dispatch_s / s.seconds for s in stages if s.seconds and TASKS[s.name] == Task.BLOCK), default=0.0
        ),
        "alone_share": sum(s.once_s for s in stages) / seconds,
        "read_bytes": sum(s.read_bytes for s in stages),
        "written_bytes": sum(s.written_bytes for s in stages),
        "worker_bytes": max(s.worker_bytes for s in stages),
    }


def as_text(found: dict) -> str:
    """The plan as the command prints it."""
    job = found["job"]
    atoms = [] if job["learns"] else ["atoms: those that ship with the program; no time of learning"]
    lines = [
        f"{job['n_splats']:,} splats, {job['n_workers']} workers: {duration(found['seconds'])}, "
        f"{found['tasks']:,} tasks, {size(found['read_bytes'])} read, {size(found['written_bytes'])} written, "
        f"{size(found['worker_bytes'])} a worker",
        f"breaks first: {found['breaks_first']}",
        f"what helps: {found['remedy']}",
        *atoms,
        "",
        f"{'stage':<16}{'tasks':>10}{'a task':>9}{'in all':>12}{'alone':>12}{'read':>10}{'written':>10}{'worker':>10}",
    ]
    if found["speed"] != 1:
        lines.insert(
            1,
            f"on machines as fast as this one, which takes {found['speed']:.2f} of the time of the one the costs are of",
        )
    lines += [
        f"{s['name']:<16}{s['n_tasks']:>10,}{s['task_s']:>8.2f}s{duration(s['seconds']):>12}{duration(s['once_s']):>12}"
        f"{size(s['read_bytes']):>10}{size(s['written_bytes']):>10}{size(s['worker_bytes']):>10}"
        for s in found["stages"]
    ]
    lines += ["", f"{'workers':>8}{'tasks a call':>15}{'time':>12}{'times 1':>9}{'scheduler busy':>16}   breaks first"]
    first = found["workers"][0]["seconds"]
    lines += [
        f"{r['workers']:>8,}{r['tasks_a_call']:>15}{duration(r['seconds']):>12}{first / r['seconds']:>9.1f}"
        f"{min(1.0, r['scheduler_share']):>16.0%}   {r['breaks_first']}"
        for r in found["workers"]
    ]
    return "\n".join(lines)
