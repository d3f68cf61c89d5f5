"""`report.json` as types, and the JSON Schema made of them.

What was not measured is null or an empty list, never a guess. Lengths are in the scan's unit. PSNR has a peak of 1 and
is null where nothing was lost, or nothing was measured. `RunRecord` is what a run knows of itself; `Report` adds what
the packed file tells (`renderer.report.report`).
"""

from __future__ import annotations

from typing import Any

import msgspec
from msgspec import UNSET, UnsetType

from pipeline.effects.plan.plan import Row
from pipeline.stages.pages.coded import PagesMade
from pipeline.summaries import VolumeSurfaces

SCHEMA_DIALECT = "https://json-schema.org/draft/2020-12/schema"


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all parts of a document: frozen, and without fields that its schema does not know."""


class ScanFacts(Part, frozen=True):
    """The scan. `n_points` are those of its file; `unused` properties of points that nothing is made from; `volume` of
    volumes alone."""

    name: str | None
    format: str | None
    n_points: int | None
    unit: str | None
    n_cameras: int
    unused: tuple[str, ...] | UnsetType = UNSET
    volume: VolumeSurfaces | UnsetType = UNSET


class Sizes(Part, frozen=True):
    """Bytes by part and compression factors, as Table 1 of the HPG 2021 paper counts them; see `sizes_of`."""

    geometry_bytes: int
    codes_bytes: int
    colors_bytes: int
    dictionary_bytes: int
    maps_bytes: int
    provenance_bytes: int
    gpu_bytes: int
    file_bytes: int
    bytes_per_splat: float
    source_texture_bytes: int | None
    compression_factor_total: float | None
    compression_factor_texture: float | None
    arrays: dict[str, int]
    shipped_bytes: int = 0
    own_bytes_per_splat: float = 0.0
    own_factor_total: float | None = None
    own_factor_texture: float | None = None


class GeometryErrors(Part, frozen=True):
    """What quantising positions and normals cost, on average."""

    mean_position_error: float
    mean_position_error_in_radii: float
    mean_normal_error_degrees: float


class ViewMeasured(Part, frozen=True):
    """One picture against the baseline (splats textured from the photographs themselves) and against the photograph.
    `coverage`, `holes` are shares of the picture; `seconds` by pass; `pictures` are paths beside the report."""

    camera: str
    width_px: int
    height_px: int
    psnr_vs_baseline_db: float | None
    ssim_vs_baseline: float | None
    psnr_vs_photo_db: float | None
    ssim_vs_photo: float | None
    baseline_psnr_vs_photo_db: float | None
    coverage: float
    holes: float | None
    seconds: dict[str, float]
    baseline_seconds: dict[str, float] | None
    device: str
    pictures: dict[str, str]
    accumulation: str | None = None
    programs: tuple[str, ...] = ()


class Quality(Part, frozen=True):
    """What was kept: PSNR of all texels, of those weighted by what of them is visible, and of resampling alone."""

    texture_psnr_db: float | None = None
    visible_psnr_db: float | None = None
    resampling_psnr_db: float | None = None
    geometry: GeometryErrors | None = None
    views: tuple[ViewMeasured, ...] = ()


class AtomsUsed(Part, frozen=True):
    """How many splats have 0, 1, ... atoms, and the mean."""

    histogram: tuple[int, ...]
    mean: float


class LearningPass(Part, frozen=True):
    """An iteration of k-SVD with exact weights: seconds since learning began, and the PSNR of the whole scan as it
    estimates it."""

    seconds: float | None = None
    psnr_db: float | None = None
    replaced_atoms: int | None = None
    accepted: bool | None = None


class HardCases(Part, frozen=True):
    """Counts of the hard cases that were met, see docs/NUMERICS.md; `accumulation` is what colours were added up in."""

    dropped_points: int | None = None
    degenerate_normals: int | None = None
    flagged_projections: int | None = None
    replaced_atoms: int | None = None
    safeguard_steps: int | None = None
    accumulation: str | None = None


class StageCost(Part, frozen=True):
    """What a stage took; `reused` where its output was there already."""

    name: str
    seconds: float | None = None
    peak_rss_bytes: int | None = None
    splats_per_second: float | None = None
    tasks: int | None = None
    reused: bool | None = None


class EstimatedFigure(Part, frozen=True):
    """What was estimated, from `low` to `high`, and what happened."""

    value: float
    low: float
    high: float
    happened: float


class EdgeShown(Part, frozen=True):
    """A close-up of an edge with cliplines and without, beside the photograph."""

    camera: str
    left_px: int
    top_px: int
    side_px: int
    with_db: float | None
    without_db: float | None
    pictures: dict[str, str]


class StationView(Part, frozen=True):
    """The packed file from near a station or away of it, with its textures and with one colour a splat: PSNR at
    `points` that the stations saw and both pictures cover."""

    camera: str
    flat_db: float | None
    textured_db: float | None
    points: int
    pictures: dict[str, str]


class StationShown(Part, frozen=True):
    """What a laser station saw. `covered` is the share of its map that shows a surface; `centre` in the scan's unit."""

    station: int
    centre: tuple[float, float, float]
    step_degrees: float
    covered: float
    pictures: dict[str, str]
    views: tuple[StationView, ...] = ()


class ScanKnown(Part, frozen=True):
    """What a run knows of its scan; what it leaves out, the packed file says."""

    name: str | UnsetType = UNSET
    format: str | UnsetType = UNSET
    n_points: int | UnsetType = UNSET
    unit: str | UnsetType = UNSET
    n_cameras: int | UnsetType = UNSET
    warnings: tuple[str, ...] = ()
    unused: tuple[str, ...] | UnsetType = UNSET
    volume: VolumeSurfaces | UnsetType = UNSET


class RunBits(Part, frozen=True):
    """Bits a splat of runs on a graphics card: starts with their tables, steps, and normals."""

    start: float
    steps: float
    normals: float


class RunsMade(Part, frozen=True):
    """Of a geometry of runs. Lengths in the scan's unit; `added` cells close gaps, a share `twice` of all is decoded
    twice."""

    cells: int
    added: int
    twice: float
    points: int
    cell: float
    hit_rate: float  # points a cell
    run_length: int
    efficiency: float  # mean length of a run by the longest
    max_error: float
    mean_error: float
    spacing: float
    mean_normal_error_degrees: float
    bits: RunBits
    disk_bits: float


class RunRecord(Part, frozen=True):
    """What a run knows of itself, beside its packed file. None or empty where it does not."""

    scan: ScanKnown = ScanKnown()
    quality: Quality = Quality()
    learning: tuple[LearningPass, ...] = ()
    numerics: HardCases = HardCases()
    stages: tuple[StageCost, ...] = ()
    settings: dict[str, Any] = {}
    effects: tuple[Row, ...] = ()
    edges: tuple[EdgeShown, ...] = ()
    stations: tuple[StationShown, ...] = ()
    estimate: dict[str, EstimatedFigure] | None = None
    runs: RunsMade | None = None
    pages: PagesMade | None = None
    found: dict[str, dict] | UnsetType = UNSET


class Report(Part, frozen=True):
    """report.json. `found` is what stages beside the packed file tell, by their names; absent where there are none."""

    scan: ScanFacts
    splats: int
    radius: float
    sizes: Sizes
    quality: Quality
    atoms: AtomsUsed
    learning: tuple[LearningPass, ...]
    numerics: HardCases
    stages: tuple[StageCost, ...]
    settings: dict[str, Any]
    estimate: dict[str, EstimatedFigure] | None
    effects: tuple[Row, ...]
    edges: tuple[EdgeShown, ...]
    stations: tuple[StationShown, ...]
    runs: RunsMade | None
    pages: PagesMade | None
    programs: tuple[str, ...]
    warnings: tuple[str, ...]
    found: dict[str, dict] | UnsetType = UNSET


def schema_of(kind: type, name: str) -> dict:
    """The JSON Schema (2020-12) of a document, under the name that it is published by."""
    return {"$schema": SCHEMA_DIALECT, "$id": f"/v1/schemas/{name}", **msgspec.json.schema(kind)}
