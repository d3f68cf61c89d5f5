"""Table 1 of HPG 2021 on any scan with photographs: a row for each way to keep its textures."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from msgspec import UNSET, UnsetType, structs

from pipeline.execution.stage import StageRecord
from pipeline.geometry.frame import directions_of
from pipeline.planning.knobs import BY_NAME
from pipeline.planning.settings import Settings
from pipeline.stages.texture.photo_codecs import CODECS, texture_bytes
from pipeline.stages.texture.photo_variants import PhotoVariant, VariantErrors, VariantMeasured
from pipeline.summaries import CodesMade
from renderer.evaluate.compare import not_measured
from renderer.report.evaluation_document import (
    AtomsByTarget,
    CloseUp,
    EvaluatedRow,
    EvaluatedScan,
    EvaluationDocument,
    Failure,
    HeldOutPhotos,
    PassTimes,
)
from renderer.report.report import sizes_of
from renderer.splats.baseline import PHOTO_BUDGET_BYTES
from services.flow.code import code_prepared
from services.flow.pack import pack
from services.flow.prepare import Prepared
from services.flow.run import Run
from services.flow.textures import Coded
from storage.packed.packed import SUFFIX, PackedFile
from storage.packed.schema import PATCH_SIZE

PHOTO_ROWS = {  # key: level of detail and codec
    "lod0": (0, "raw"),
    "lod0-bc7": (0, "bc7"),
    "lod0-bc1": (0, "bc1"),
    "lod0-bc1-fast": (0, "bc1-fast"),
    "lod1": (1, "raw"),
    "lod1-bc7": (1, "bc7"),
    "lod1-bc1": (1, "bc1"),
    "lod1-bc1-fast": (1, "bc1-fast"),
}
CODED_ROWS = {"d8w4": (8, 4), "d12w4": (12, 4), "d16w8": (16, 8)}  # key: dictionary bits and weight bits
PICTURE_ROWS = ("jpeg", "webp", "avif")
ROWS = (*PHOTO_ROWS, *CODED_ROWS, "average", "per-splat", *PICTURE_ROWS)


@dataclass
class Evaluation:
    """What is known so far."""

    run: Run
    scan: Path
    out: Path
    settings: Settings
    prepared: Prepared
    patches: StageRecord
    rows: dict[str, EvaluatedRow] = field(default_factory=dict)
    coded: dict[str, Coded] = field(default_factory=dict)
    packed: dict[str, Path] = field(default_factory=dict)
    photos: dict[str, Path] = field(default_factory=dict)  # folders of PhotoVariant
    atoms: AtomsByTarget | None = None
    close_ups: tuple[CloseUp, ...] = ()
    close_ups_of: str | UnsetType = UNSET
    passes: tuple[PassTimes, ...] = ()
    held_out: HeldOutPhotos | None = None
    failed: list[Failure] = field(default_factory=list)
    pool_bytes: int = PHOTO_BUDGET_BYTES  # of photographs on the GPU: those that exceed it are drawn by pages

    @property
    def n_splats(self) -> int:
        return self.prepared.splats.summary.n_splats


def coders() -> tuple[str, ...]:
    """All coders there are to choose from, the published one first."""
    return BY_NAME["coder"].choices if "coder" in BY_NAME else ("",)


def average_row(e: Evaluation) -> None:
    """Splats of one colour; the geometry of all rows is this one's."""
    coded_row(e, "average", "", max_atoms=0)
    e.rows["average"] = structs.replace(e.rows["average"], name="average colour", coder="none")


def coded_row(e: Evaluation, key: str, coder: str, **changes) -> None:
    """A row of our own: the scan coded by `coder`, with the bits that the key names or other changes of settings."""
    if key in CODED_ROWS:
        changes |= dict(zip(("dictionary_bits", "weight_bits"), CODED_ROWS[key]))
    settings = replace(e.settings, **(changes | ({"coder": coder} if coder else {})))
    n_before = len(e.run.records)
    coded = code_prepared(e.run, e.prepared, e.patches, settings)
    seconds = sum(record.made_seconds for record in e.run.records[n_before:])
    name = coded_name(key, coder)
    path = e.out / (name + SUFFIX)
    pack(e.run, e.prepared, coded, settings, e.scan.stem, path)
    with PackedFile(path) as packed:
        sizes = sizes_of(packed.load(), path.stat().st_size)
    quality = coded.codes.summary
    row = _row(
        e,
        name,
        key.upper(),
        coder or "k-SVD",
        "ours",
        sizes.gpu_bytes - sizes.geometry_bytes,
        quality,
        seconds,
        sizes.geometry_bytes,
    )
    e.rows[name] = structs.replace(
        row,
        n_dictionary=coded.n_dictionary,
        mean_atoms=quality.mean_atoms,
        file_bytes=sizes.file_bytes,
        learning=coded.learning,
    )
    e.coded[name], e.packed[name] = coded, path


def coded_name(key: str, coder: str) -> str:
    """What a coded row is called: its key, with its coder where there are several."""
    return f"{key}-{coder}" if coder else key


def photo_row(e: Evaluation, key: str, lod: int, codec: str, bytes_per_pixel: float | None = None) -> None:
    """A row of the photographs, halved `lod` times and left as a codec leaves them."""
    variant = e.run.do(PhotoVariant(e.prepared.photos, lod, codec, bytes_per_pixel))
    errors = e.run.do(
        VariantErrors(
            variant.folder,
            e.prepared.partition.folder,
            e.prepared.splats.folder,
            e.patches.folder,
            e.prepared.radius,
            *directions_of(e.prepared.scan.summary.cameras),
        )
    )
    kind = CODECS[codec]
    name = kind.title if not kind.renderable else f"photos LOD {lod}" + (f" {kind.title}" if codec != "raw" else "")
    shown = "photos" if kind.renderable else "pictures"
    e.rows[key] = _row(e, key, name, kind.encoder, shown, variant.summary.bytes, errors.summary, variant.made_seconds)
    if kind.renderable:
        e.photos[key] = variant.folder


def picture_row(e: Evaluation, codec: str) -> None:
    """At the bytes of our textures: of the first coded row, or of BC1 at LOD 1 where there is none."""
    coded = next((row for row in e.rows.values() if row.kind == "ours" and row.n_dictionary), None)
    cameras = e.prepared.scan.summary.cameras
    n_pixels = sum(c.width_px * c.height_px for c in cameras)
    photo_row(e, codec, 0, codec, coded.texture_bytes / n_pixels if coded else 1 / 6)


def per_splat_row(e: Evaluation) -> None:
    """One texture a splat, as in an atlas: what our patches are before they are coded."""
    n_bytes = e.n_splats * texture_bytes(PATCH_SIZE, PATCH_SIZE, lambda w, h: 3 * w * h)
    nothing_lost = VariantMeasured(None, None)
    e.rows["per-splat"] = _row(
        e, "per-splat", "one texture a splat", "none", "atlas", n_bytes, nothing_lost, e.patches.made_seconds
    )


def _row(
    e: Evaluation,
    key: str,
    name: str,
    coder: str,
    kind: str,
    n_bytes: int,
    quality: CodesMade | VariantMeasured,
    seconds: float,
    geometry: int | None = None,
) -> EvaluatedRow:
    geometry = geometry or e.rows["average"].geometry_bytes
    return EvaluatedRow(
        key=key,
        name=name,
        coder=coder,
        kind=kind,
        texture_bytes=int(n_bytes),
        geometry_bytes=int(geometry),
        bytes_per_splat=(n_bytes + geometry) / e.n_splats,
        texture_psnr_db=quality.texture_psnr_db,
        visible_psnr_db=quality.visible_psnr_db,
        seconds=seconds,
    )


def document_of(e: Evaluation, wanted: list[str], complete: bool = False) -> EvaluationDocument:
    """The rows in the paper's order, with their factors against the photographs as they are."""
    raw, shown = e.rows.get("lod0"), []
    for key in ROWS:
        for name, row in e.rows.items():
            if key in wanted and (name == key or name.startswith(key + "-") and key in CODED_ROWS):
                shown.append(_with_factors(raw, row))
    summary = e.prepared.scan.summary
    return EvaluationDocument(
        scan=EvaluatedScan(e.scan.resolve().name, summary.format, len(summary.cameras)),
        splats=e.n_splats,
        radius=e.prepared.radius,
        resampling_psnr_db=e.patches.summary.resampling_psnr_db,
        rows=tuple(shown),
        target_psnr_db=e.settings.target_psnr_db,
        n_workers=e.run.executor.n_workers,
        failed=tuple(e.failed),
        not_measured=not_measured(),
        complete=complete,
        atoms=e.atoms,
        close_ups=e.close_ups,
        passes=e.passes,
        held_out=e.held_out,
        close_ups_of=e.close_ups_of,
    )


def _with_factors(raw: EvaluatedRow | None, row: EvaluatedRow) -> EvaluatedRow:
    """Against the photographs as they are; None where that row failed."""
    if raw is None:
        return row
    return structs.replace(
        row,
        factor_total=(raw.texture_bytes + raw.geometry_bytes) / (row.texture_bytes + row.geometry_bytes),
        factor_texture=raw.texture_bytes / row.texture_bytes,
    )
