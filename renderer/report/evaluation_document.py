"""`evaluate.json` as types; as `renderer.report.document` has those of report.json."""

from __future__ import annotations

from msgspec import UNSET, UnsetType

from renderer.report.document import LearningPass, Part


class EvaluatedScan(Part, frozen=True):
    """The scan that was evaluated."""

    name: str
    format: str
    n_cameras: int


class EvaluatedRow(Part, frozen=True):
    """A row of Table 1: `kind` is photos, pictures, ours or atlas. PSNR is null where nothing is lost; factors are
    against the photographs as they are."""

    key: str
    name: str
    coder: str
    kind: str
    texture_bytes: int
    geometry_bytes: int
    bytes_per_splat: float
    texture_psnr_db: float | None
    visible_psnr_db: float | None
    seconds: float
    n_dictionary: int | None = None
    mean_atoms: float | None = None
    file_bytes: int | None = None
    learning: tuple[LearningPass, ...] = ()
    factor_total: float | None = None
    factor_texture: float | None = None
    picture_psnr_db: float | None = None  # against photographs, from their cameras; of what is drawn alone


class AtomsByTarget(Part, frozen=True):
    """Figure 9: how many splats of a sample have 0, 1, ... atoms, by target."""

    row: str
    n_splats: int
    targets_db: tuple[float, ...]
    histograms: tuple[tuple[int, ...], ...]


class PictureFigures(Part, frozen=True):
    """A picture against the first variant's."""

    psnr_db: float | None
    ssim: float | None
    flip: float | None


class CloseUp(Part, frozen=True):
    """One place, drawn with each variant; `figures` of the first one are null."""

    why: str
    camera: str
    texture_psnr_db: float | None
    pictures: dict[str, str]
    figures: dict[str, PictureFigures | None]


class PassTimes(Part, frozen=True):
    """Median seconds of each pass of one view."""

    name: str
    seconds: dict[str, float]
    device: str
    width_px: int
    height_px: int


class HeldOutView(Part, frozen=True):
    """A photograph that nothing was textured from; `matched_psnr_db` once the light has its gain."""

    camera: str
    width_px: int
    height_px: int
    coverage: float
    psnr_db: float | None
    matched_psnr_db: float | None
    ssim: float | None
    flip: float | None
    pictures: dict[str, str]


class HeldOutPhotos(Part, frozen=True):
    """Every so many-th photograph, kept out of texturing and compared with."""

    every: int
    n_photos: int
    n_uncoloured: int
    views: tuple[HeldOutView, ...]


class Failure(Part, frozen=True, rename={"kind": "class"}):
    """A row or figure that failed."""

    name: str
    kind: str
    error: str


class EvaluationDocument(Part, frozen=True):
    """evaluate.json; `complete` once all rows and figures that were asked for have been tried."""

    scan: EvaluatedScan
    splats: int
    radius: float
    resampling_psnr_db: float | None
    rows: tuple[EvaluatedRow, ...]
    target_psnr_db: float
    n_workers: int
    failed: tuple[Failure, ...]
    not_measured: str | None
    complete: bool
    atoms: AtomsByTarget | None
    close_ups: tuple[CloseUp, ...]
    passes: tuple[PassTimes, ...]
    held_out: HeldOutPhotos | None
    close_ups_of: str | UnsetType = UNSET
