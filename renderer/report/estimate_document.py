"""estimate.json, what a job would take, as types; as `renderer.report.document` has those of report.json."""

from __future__ import annotations

from msgspec import UNSET, UnsetType

from renderer.report.document import Part


class Banded(Part, frozen=True):
    """A figure, from `low` to `high`."""

    value: float
    low: float
    high: float


class PartSizes(Part, frozen=True):
    """Bytes on the GPU by part; of maps where they are the texture."""

    geometry_bytes: int
    codes_bytes: int
    colors_bytes: int
    dictionary_bytes: int
    gpu_bytes: int
    maps_bytes: int | UnsetType = UNSET


class StageSeconds(Part, frozen=True):
    """What a stage would take, of the clock and of processors, and what the pilot took."""

    name: str
    seconds: float
    processor_seconds: float
    pilot_seconds: float
    pilot_processor_seconds: float


class LearningEstimated(Part, frozen=True):
    """Patches and atoms of the job's learning, and of the pilot's; empty where nothing is learned."""

    n_wanted: int | UnsetType = UNSET
    n_active: int | UnsetType = UNSET
    n_patches: int | UnsetType = UNSET
    n_patches_pilot: int | UnsetType = UNSET
    n_atoms: int | UnsetType = UNSET
    n_atoms_pilot: int | UnsetType = UNSET


class Pilot(Part, frozen=True):
    """What the estimate was made from: splats, patches and passes of learning, and the seconds of it."""

    n_splats: int
    n_training: int | None
    iterations: int
    seconds: float


class EstimateDocument(Part, frozen=True):
    """Seconds up to the packed file, peak memory of a worker, bytes on the GPU, of the file and of its pages, texture
    PSNR and picture PSNR, which is of pictures against the photographs. A figure is null where the job has none."""

    seconds: Banded
    peak_memory_bytes: Banded
    gpu_bytes: Banded
    file_bytes: Banded
    texture_psnr_db: Banded | None
    pages_bytes: Banded | None
    bytes_per_splat: float
    splats: int
    n_workers: int
    sizes: PartSizes
    stages: tuple[StageSeconds, ...]
    learning: LearningEstimated
    preset: str
    sample: Pilot
    picture_psnr_db: Banded | None = None
