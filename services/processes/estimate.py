"""What a job would take, before it runs: its splats in full, and a pilot of the coder on a stratified sample of them.

All up to the splats and their effects is done in full: it is the smaller part, it decides which effects are on, and a
job in the same work folder uses it again. The coder's stages run on SAMPLE splats. Nothing here knows how they work;
known of each is whether it goes by splats or by training patches.
"""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from pipeline.coding.grid import SYMMETRIES, AtomForm
from pipeline.coding.passes import quantised_share, rounds_of_passes
from pipeline.execution.stage import Executor, Progress, Stage, StageRecord
from pipeline.numerics.accuracy import squared_error_at
from pipeline.planning.dictionary_size import PATCHES_AN_ATOM, index_bits
from pipeline.planning.settings import Settings
from pipeline.stages.points.sampled import Sampled, chosen_rows
from pipeline.stages.texture.contrast_octaves import shares
from pipeline.stages.texture.dictionary import KsvdUpdate
from pipeline.stages.texture.encode import Encode
from pipeline.stages.texture.multipliers import Multipliers, least_multiplier, multiplier_for
from pipeline.stages.texture.quantise import Quantisation
from pipeline.stages.texture.resample import Resample
from pipeline.stages.texture.training import TrainingSet, held_share
from pipeline.summaries import AverageColors
from renderer.evaluate.compare import psnr_of_error
from renderer.evaluate.picture_psnr import sampled_picture_error
from renderer.report.document import Sizes
from renderer.report.estimate_document import EstimateDocument
from renderer.report.report import sizes_of
from services.flow.asked import prepare_asked
from services.flow.code import chosen_maps, code_prepared, mapped_by, resample
from services.flow.estimate_cache import keep_estimate
from services.flow.maps import Mapped
from services.flow.pack import pack
from services.flow.prepare import Prepared, wants_texture
from services.flow.run import Run
from services.flow.textures import Coded, n_held
from services.processes.estimate_gaps import Slope, Sorts, gain_of_passes, membership, outcome_in_job, slope_at
from services.processes.estimate_pages import PagesEstimated, estimate_pages
from storage.errors import ResourceExhausted
from storage.packed.layout import LOCAL_HEADER_BYTES, group_members
from storage.packed.packed import SUFFIX, PackedFile
from storage.packed.schema import ATOM_SIZES, EXTRAS, GROUP
from storage.work import arrays, work
from storage.work.stage_lock import stage_lock

SAMPLE = 2 * arrays.BLOCK  # splats: two tasks of full size
MOST_TRAINING = 16_384  # patches that the pilot learns from
MOST_ATOMS = MOST_TRAINING // PATCHES_AN_ATOM
MOST_PRODUCTS = 4 * 12_288 * 4096  # of a patch and an atom in one of its turns: four passes of learning for most scans
BANDS = {
    "seconds": 0.25,
    "gpu_bytes": 0.05,
    "file_bytes": 0.05,
    "texture_psnr_db": 0.5,
    "picture_psnr_db": 0.5,
    "peak_memory_bytes": 0.25,
    "pages_bytes": 0.15,
}


@dataclass(frozen=True)
class _Pilot:
    """What the sample showed."""

    prepared: Prepared  # with all splats
    coded: Coded | None
    settings: Settings  # the pilot's own
    sizes: Sizes
    grouped_bytes: int  # of the file, in groups of splats
    a_group_bytes: int  # of these, what a group takes whatever it holds: heads of its members in the zip
    n_sample: int
    stages: list[tuple[Stage, StageRecord]]
    full: list[StageRecord]  # stages with all splats
    n_workers: int
    mapped: Mapped | None = None
    pages: PagesEstimated | None = None
    picture_error: float | None = None  # squared, to the photographs, a channel in levels of 255

    @property
    def n_splats(self) -> int:
        return self.prepared.splats.summary.n_splats

    @property
    def share(self) -> float:
        return self.n_sample / self.n_splats


def estimate(
    scan: Path, settings: Settings, executor: Executor, progress: Progress, work_folder: Path | None = None
) -> EstimateDocument:
    """Seconds up to the packed file (previews not among them), peak memory of a worker, bytes on the GPU and of the
    file, texture and picture PSNR, each with a band, those of a page file beside it, and what each stage adds to the seconds.

    With `work_folder` the full part stays there, and so does the estimate, for the report of the job that follows.

    Raises: what compress raises for a scan that cannot be read.
    """
    scratch = (
        Path(tempfile.mkdtemp(prefix=".estimate-", dir=work_folder))
        if work_folder
        else Path(tempfile.mkdtemp(prefix="splatpress-estimate-"))
    )
    try:
        run = Run(work_folder or scratch, executor, progress)
        run.step = lambda stage, do: _one_at_a_time(work.stage_folder(run.work, stage), do)
        told = _scaled(_pilot(run, scan, settings, scratch), settings)
        found = msgspec.convert(told, EstimateDocument)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    if work_folder:
        keep_estimate(work_folder, settings, found)
    return found


def _one_at_a_time(folder: Path, do: Callable[[], StageRecord]) -> StageRecord:
    with stage_lock(folder):
        return do()


# --- the pilot --------------------------------------------------------------------------------------------------------


def _pilot(run: Run, scan: Path, settings: Settings, scratch: Path) -> _Pilot:
    prepared = prepare_asked(run, scan, settings)
    ran: dict[Path, tuple[Stage, StageRecord]] = {}

    def noted(stage: Stage, do: Callable[[], StageRecord]) -> StageRecord:
        record = do()
        ran.setdefault(record.folder, (stage, record))
        return record

    pilot = Run(scratch / "pilot", run.executor, run.progress, step=noted)
    pilot.work.mkdir(parents=True, exist_ok=True)
    sampled = _sampled(pilot, prepared)
    coded, mapped, own = None, None, settings
    pictures = None
    if textured := wants_texture(prepared, settings.texture):
        pictures, _ = chosen_maps(run, prepared, settings)  # of all points, whatever the sample
    if pictures:
        mapped = mapped_by(pilot, sampled, settings, pictures)
    elif textured:
        patches = resample(pilot, sampled)
        own = _affordable(settings, patches, prepared)
        coded = code_prepared(pilot, sampled, patches, own, prepared.splats.summary.n_splats)
    path = scratch / f"pilot{SUFFIX}"
    pack(pilot, sampled, coded, own, "pilot", path, mapped)
    with PackedFile(path) as packed:
        sizes = sizes_of(packed.load(), path.stat().st_size)
        grouped_bytes = int(packed.groups.bytes.sum())
        heads = [] if packed.is_archive else group_members(packed.header, 0)
        a_group_bytes = sum(LOCAL_HEADER_BYTES + len(member) for _, member in heads)
    stages = [(stage, record) for stage, record in ran.values() if stage.name != Sampled.name]
    return _Pilot(
        prepared,
        coded,
        own,
        sizes,
        grouped_bytes,
        a_group_bytes,
        sampled.splats.summary.n_splats,
        stages,
        list(run.records),
        run.executor.n_workers,
        mapped,
        estimate_pages(run, prepared, settings, scratch / "pages"),
        _picture_error(run, prepared, settings, path, scratch) if coded else None,
    )


def _picture_error(run: Run, prepared: Prepared, settings: Settings, sample: Path, scratch: Path) -> float | None:
    """That of pictures of a sample's file to the photographs, where all splats of the scan hide what lies behind them;
    None where nothing can be drawn."""
    apart, of_all = Run(scratch / "all", run.executor, run.progress), scratch / f"all{SUFFIX}"
    apart.work.mkdir(parents=True, exist_ok=True)
    pack(apart, prepared, None, settings, "all", of_all)
    rows = chosen_rows(prepared.splats.summary.n_splats, SAMPLE)
    try:
        return run.paint(sampled_picture_error, of_all, sample, rows, prepared.photos)
    except ResourceExhausted:
        return None


def _sampled(pilot: Run, prepared: Prepared) -> Prepared:
    """A sample of the splats, and of what effects add to each of them."""

    def of(source: Path) -> StageRecord:
        return pilot.do(Sampled(source, prepared.partition.folder, SAMPLE))

    partition, splats, streams = (
        of(prepared.partition.folder),
        of(prepared.splats.folder),
        {extra.stream for extra in EXTRAS},
    )
    built = tuple((name, of(folder).folder if name in streams else folder) for name, folder in prepared.built)
    return replace(prepared, partition=partition, splats=splats, built=built)


def _affordable(settings: Settings, patches: StageRecord, prepared: Prepared) -> Settings:
    """The settings, with as little learning as seconds allow: patches for the atoms that the job will have, and
    passes."""
    form = (
        None if settings.coder == "paper" else AtomForm(ATOM_SIZES[-1], SYMMETRIES)
    )  # the smallest atoms are the most
    n_turns = (form or AtomForm()).n_turns
    of_maps = patches.summary.map_texels is not None
    n_indices = 2 ** index_bits(settings, form, prepared.splats.summary.n_splats, of_maps)
    n_atoms = min(n_indices // n_turns, settings.training_splats // PATCHES_AN_ATOM, MOST_ATOMS)
    n_training = min(settings.training_splats, max(3 * MOST_TRAINING // 4, n_atoms * PATCHES_AN_ATOM))
    passes = max(2, MOST_PRODUCTS // (n_training * n_atoms * n_turns))
    return replace(settings, training_splats=n_training, iterations=min(settings.iterations, passes))


# --- from the sample to the scan --------------------------------------------------------------------------------------


def _scaled(pilot: _Pilot, settings: Settings) -> dict:
    learning = _learning(pilot, settings)
    rows = [_row(r, r.made_seconds, _processor_seconds(r)) for r in pilot.full]
    rows += [_row(record, *_stage_seconds(pilot, stage, record, settings, learning)) for stage, record in pilot.stages]
    rows += [_row(pages.record, pages.seconds, pages.processor_seconds)] if (pages := pilot.pages) else []
    rows = _merged(rows)
    loss, taken = _job_for_pilot(pilot, settings, learning)
    sizes = _sizes(pilot, learning, taken)
    memory = max(r.peak_rss_bytes for r in [*pilot.full, *(record for _, record in pilot.stages)])
    figures = {
        "seconds": sum(row["seconds"] for row in rows),
        "peak_memory_bytes": memory,
        "gpu_bytes": sizes["gpu_bytes"],
        "file_bytes": _file_bytes(pilot, sizes),
        "texture_psnr_db": _psnr_db(pilot, loss),
        "picture_psnr_db": _picture_psnr_db(pilot, loss),
        "pages_bytes": pages.bytes if pages else None,
    }
    return {name: _banded(name, value) for name, value in figures.items()} | {
        "bytes_per_splat": sizes["gpu_bytes"] / pilot.n_splats,
        "splats": pilot.n_splats,
        "n_workers": pilot.n_workers,
        "sizes": sizes,
        "stages": rows,
        "learning": learning,
        "preset": settings.preset,
        "sample": {
            "n_splats": pilot.n_sample,
            "n_training": learning.get("n_patches_pilot"),
            "iterations": pilot.settings.iterations,
            "seconds": sum(row["pilot_seconds"] for row in rows),
        },
    }


def _row(record: StageRecord, seconds: float, processor_seconds: float) -> dict:
    return {
        "name": record.name,
        "seconds": seconds,
        "processor_seconds": processor_seconds,
        "pilot_seconds": record.made_seconds,
        "pilot_processor_seconds": _processor_seconds(record),
    }


def _processor_seconds(record: StageRecord) -> float:
    """Of a stage's tasks."""
    return sum(task.processor_seconds for task in work.finished_tasks(record.folder).values())


def _banded(name: str, value: float | None) -> dict | None:
    """A figure from `low` to `high`."""
    if value is None:
        return None
    off = BANDS[name] if name.endswith("_db") else BANDS[name] * value
    return {"value": value, "low": value - off, "high": value + off}


def _learning(pilot: _Pilot, settings: Settings) -> dict:
    """Patches and atoms of the job's learning, and of the pilot's."""
    if pilot.coded is None or pilot.coded.quantised is None:
        return {}
    training = next(record for _, record in pilot.stages if record.name == TrainingSet.name).summary
    n_active = training.n_active / pilot.share
    n_chosen = min(settings.training_splats + n_held(settings), n_active)
    held, held_pilot = (
        0.0 if settings.coder == "paper" else held_share(int(n)) for n in (n_chosen, training.n_patches)
    )
    n_patches = n_chosen * (1 - held)
    found = pilot.coded.quantised.summary
    form = None if settings.coder == "paper" else AtomForm(found.atom_size, found.n_turns)
    of_maps = pilot.coded.patches.summary.map_texels is not None
    most = 2 ** index_bits(settings, form, pilot.n_splats, of_maps) // found.n_turns
    n_atoms = max(1, min(most, int(n_patches) // PATCHES_AN_ATOM))
    if pilot.coded.shipped or pilot.coded.n_dictionary < min(most, training.n_patches // PATCHES_AN_ATOM):
        n_atoms = pilot.coded.n_dictionary  # its codes pay for no more, nor will the job's
    return {
        "n_wanted": settings.training_splats,
        "n_active": int(n_active),
        "n_patches": int(n_patches),
        "n_patches_pilot": int(training.n_patches * (1 - held_pilot)),
        "n_atoms": n_atoms,
        "n_atoms_pilot": pilot.coded.n_dictionary,
    }


def _stage_seconds(
    pilot: _Pilot, stage: Stage, record: StageRecord, settings: Settings, learning: dict
) -> tuple[float, float]:
    """A stage's wall time: what its tasks take, by the splat or the patch, shared by the workers, and what it takes
    once; and the processor time of its tasks.

    Tasks count without the kernels that they compiled: those are there when the job runs. Of the first stage the
    fastest task counts, as the others met a worker without pages of memory.
    """
    tasks = work.finished_tasks(record.folder).values()
    busy = sum(task.seconds for task in tasks)
    once = (
        max(0.0, record.made_seconds - busy / len(tasks) * -(-len(tasks) // pilot.n_workers))
        if tasks
        else record.made_seconds
    )
    used = sum(task.processor_seconds for task in tasks)
    if record.n_splats:
        busy, used = (
            record.n_splats * _rate(tasks, clock, cold=stage.name == Resample.name)
            for clock in ("seconds", "processor_seconds")
        )
    atoms = learning["n_atoms"] / max(1, learning["n_atoms_pilot"]) if learning else 1.0
    if hasattr(stage, "training") or stage.name == TrainingSet.name:
        n_patches = min(learning.get("n_patches", 0), getattr(stage, "most_patches", np.inf))
        factor = n_patches / record.n_splats if learning and record.n_splats else 1.0
        passes = 1.0
        if record.name == KsvdUpdate.name:
            passes, share = _passes(pilot, settings, int(n_patches), getattr(stage, "quantised", None) is not None)
            factor *= share
        if isinstance(stage, Quantisation) and settings.coder != "paper":
            factor *= quantised_share(int(n_patches)) / stage.share
        return passes * atoms * (
            once + _shared(busy * factor, len(tasks) * factor, pilot.n_workers)
        ), passes * atoms * used * factor
    atoms = atoms if record.name == Encode.name else 1.0
    return once + _shared(
        busy * atoms / pilot.share, len(tasks) / pilot.share, pilot.n_workers
    ), used * atoms / pilot.share


def _rate(tasks: Iterable[work.TaskRecord], clock: str, cold: bool) -> float:
    """Seconds a splat."""
    taken = [(getattr(t, clock) * max(0.0, 1 - t.compile_seconds / t.seconds), t.n_splats) for t in tasks if t.n_splats]
    return min(s / n for s, n in taken) if cold else sum(s for s, _ in taken) / sum(n for _, n in taken)


def _gain_of_passes(pilot: _Pilot, settings: Settings) -> float:
    curve = [row.psnr_db for row in pilot.coded.learning]
    if None in curve or len(curve) < _rounds(pilot.settings)[0][1]:
        return 0.0
    n_passes = (
        len(curve) * settings.iterations // pilot.settings.iterations
    )  # to the curve's as the job's to the pilot's
    return gain_of_passes(curve, n_passes, settings.least_gain_db)


def _rounds(settings: Settings, n_patches: int = 1) -> tuple[tuple[float, int], ...]:
    """Shares of the patches and passes over them, with exact weights and then, but for the paper's coder, as coded."""
    return (
        ((1.0, settings.iterations),) if settings.coder == "paper" else rounds_of_passes(settings.iterations, n_patches)
    )


def _passes(pilot: _Pilot, settings: Settings, n_patches: int, as_coded: bool) -> tuple[float, float]:
    """Passes of the job for one of the pilot, whose exact ones may have ended early as the job's will; and the share of
    `n_patches` that they look at."""
    n_pilot, (share, n_passes) = _rounds(pilot.settings)[as_coded][1], _rounds(settings, n_patches)[as_coded]
    ended = not as_coded and len(pilot.coded.learning) < n_pilot
    return (1.0 if ended else n_passes / n_pilot), share


def _shared(busy: float, n_tasks: float, n_workers: int) -> float:
    """Wall time of `n_tasks` equal tasks: the last round may leave workers idle."""
    n_tasks = max(1, int(np.ceil(n_tasks)))
    return busy / n_tasks * -(-n_tasks // n_workers)


def _merged(rows: list[dict]) -> list[dict]:
    merged: dict[str, dict] = {}
    for row in rows:
        known = merged.setdefault(row["name"], dict.fromkeys(row, 0.0) | {"name": row["name"]})
        for clock in row.keys() - {"name"}:
            known[clock] += row[clock]
    return list(merged.values())


def _sizes(pilot: _Pilot, learning: dict, taken: float) -> dict:
    """Bytes by part: the dictionary by its atoms, codes by the `taken` atoms of a splat, all else by the splat."""
    sizes = {name: getattr(pilot.sizes, f"{name}_bytes") / pilot.share for name in ("geometry", "codes", "colors")}
    sizes["dictionary"] = pilot.sizes.dictionary_bytes * (
        learning["n_atoms"] / learning["n_atoms_pilot"] if learning else 1
    )
    sizes["codes"] *= taken
    if pilot.mapped:  # pictures are as large whatever the sample; a byte a splat names its own
        sizes["maps"] = pilot.sizes.maps_bytes + pilot.n_splats - pilot.n_sample
    return {f"{name}_bytes": int(n) for name, n in sizes.items()} | {"gpu_bytes": int(sum(sizes.values()))}


def _file_bytes(pilot: _Pilot, sizes: dict) -> float:
    """Groups of splats are stored in as many bytes for those on the GPU as the pilot's are, what all share likewise."""
    splats, shared = ("geometry_bytes", "codes_bytes", "colors_bytes"), ("dictionary_bytes", "maps_bytes")
    of_splats, of_shared = (sum(getattr(pilot.sizes, name) for name in names) for names in (splats, shared))
    more = sum(sizes.get(name, 0) for name in shared) / of_shared if of_shared else 1.0
    rest = pilot.sizes.file_bytes - pilot.grouped_bytes
    heads, of_sample = (pilot.a_group_bytes * -(-n // GROUP) for n in (pilot.n_splats, pilot.n_sample))
    held = pilot.grouped_bytes - of_sample
    return heads + held * sum(sizes[name] for name in splats) / of_splats + rest * more


def _psnr_db(pilot: _Pilot, loss: float) -> float | None:
    if pilot.mapped:
        return pilot.mapped.texture_psnr_db
    found = pilot.coded.codes.summary.texture_psnr_db if pilot.coded else None
    return None if found is None or not loss else found - 10 * math.log10(loss)


def _picture_psnr_db(pilot: _Pilot, loss: float) -> float | None:
    """Pictures lose what textures lose more in the job than in the pilot."""
    if pilot.picture_error is None:
        return None
    textures = pilot.coded.codes.summary.texture_psnr_db if pilot.coded else None
    more = 0.0 if textures is None else (loss - 1) * squared_error_at(textures, 1)
    return psnr_of_error(max(0.0, pilot.picture_error + more))


def _job_for_pilot(pilot: _Pilot, settings: Settings, learning: dict) -> tuple[float, float]:
    """Squared error and atoms of the job's splats, for one of each of the pilot's."""
    if not learning or pilot.coded.shipped:  # which was learned from none of them
        return 1.0, 1.0
    stage, record = next((stage, record) for stage, record in pilot.stages if isinstance(stage, TrainingSet))
    held = 0.0 if settings.coder == "paper" else held_share(record.summary.n_patches)
    active, learned, octave = membership(stage, record.folder, held)
    error, n_atoms = (arrays.read(pilot.coded.codes.folder, name).astype(float) for name in ("error", "n_atoms"))
    multipliers = next(
        (r.summary for _, r in reversed(pilot.stages) if r.name == Multipliers.name), None
    )  # the last: by it the pilot was coded
    slope = Slope(None)
    if multipliers:
        slope = slope_at(
            multiplier_for(multipliers, record.summary), multipliers, least_multiplier(multipliers, record.summary)
        )
    census = np.array(work.summary(stage.colors, AverageColors).census) / pilot.share
    a_patch = (learning["n_atoms"] / learning["n_patches"]) / (learning["n_atoms_pilot"] / learning["n_patches_pilot"])
    job = outcome_in_job(
        Sorts(octave[active], learned[active], error[active], n_atoms[active]),
        shares(census, stage.tolerance, learning["n_wanted"]),
        min(1.0, a_patch),
        slope,
        pilot.settings.budget_bytes is not None,
        _gain_of_passes(pilot, settings),
    )
    return (job.error + error[~active].sum()) / max(1e-30, error.sum()), job.n_atoms / max(1e-9, n_atoms[active].sum())
