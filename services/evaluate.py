"""The evaluation of HPG 2021, section 4, on any scan with photographs: what each way to keep its textures costs and loses."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

from pipeline.geometry.frame import directions_of
from pipeline.knobs import BY_NAME
from pipeline.photo_codecs import CODECS, texture_bytes
from pipeline.settings import Settings
from pipeline.stage import Executor, Progress, StageRecord
from pipeline.stages.patch_sample import PatchSample
from pipeline.stages.photo_variants import PhotoVariant, VariantErrors
from renderer.close_ups import Variant, draw_close_ups, time_passes
from renderer.evaluation_page import write_evaluation
from renderer.held_out import HeldOut, compare_held_out
from renderer.report import sizes_of
from services.coder import Coded, encode
from services.run import Run
from services.workflow import Prepared, code, code_prepared, is_textured, pack, prepare, put_in_place, resample
from storage import arrays
from storage.errors import InvalidScan
from storage.packed import SUFFIX, PackedFile, PackedScene
from storage.schema import PATCH_SIZE

PHOTO_ROWS = {  # key: level of detail and codec
    "lod0": (0, "raw"), "lod0-bc7": (0, "bc7"), "lod0-bc1": (0, "bc1"), "lod0-bc1-fast": (0, "bc1-fast"),
    "lod1": (1, "raw"), "lod1-bc7": (1, "bc7"), "lod1-bc1": (1, "bc1"), "lod1-bc1-fast": (1, "bc1-fast"),
}
CODED_ROWS = {"d8w4": (8, 4), "d12w4": (12, 4), "d16w8": (16, 8)}  # key: dictionary bits and weight bits
PICTURE_ROWS = ("jpeg", "webp", "avif")
ROWS = (*PHOTO_ROWS, *CODED_ROWS, "average", "per-splat", *PICTURE_ROWS)
FIGURE_9_TARGETS_DB = tuple(range(28, 49, 2))
FIGURE_9_SPLATS = 16_384


@dataclass
class _Evaluation:
    """What is known so far."""

    run: Run
    scan: Path
    out: Path
    settings: Settings
    prepared: Prepared
    patches: StageRecord
    rows: dict[str, dict] = field(default_factory=dict)
    coded: dict[str, Coded] = field(default_factory=dict)
    packed: dict[str, Path] = field(default_factory=dict)
    photos: dict[str, Path] = field(default_factory=dict)  # folders of PhotoVariant

    @property
    def n_splats(self) -> int:
        return self.prepared.splats.summary["n_splats"]


def evaluate(scan: Path, out: Path, settings: Settings, executor: Executor, progress: Progress, *,
             rows: Iterable[str] = ROWS, hold_out: int | None = None, render: bool = True, work: Path | None = None) -> dict:
    """Measure the chosen rows of Table 1 and what the figures need; writes evaluate.json and evaluate.html into `out`.

    `settings` are those of the coded rows, but for the bits that name them. With `hold_out` every N-th photograph is
    kept out of texturing and compared with. `out` appears with all of it, or not at all.

    Raises: InvalidScan for a scan without photographs.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        run = Run(work or made / "work", executor, progress)
        document = _measure(run, scan, made, settings, list(rows), hold_out, render)
        write_evaluation(made, document)
        shutil.rmtree(made / "work", ignore_errors=True)
        put_in_place(made, out)
        return document
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _measure(run: Run, scan: Path, out: Path, settings: Settings, wanted: list[str], hold_out: int | None, render: bool) -> dict:
    prepared = prepare(run, scan, settings.radius, settings.effects, density=settings.density)
    if not is_textured(prepared):
        raise InvalidScan(str(scan), "no photograph that sees any of its points", "a scan with photographs: there is no texture to evaluate")
    packed = out / "work" / "packed"
    packed.mkdir(parents=True, exist_ok=True)
    evaluation = _Evaluation(run, scan, packed, settings, prepared, resample(run, prepared))
    _average_row(evaluation)
    for key in (key for key in CODED_ROWS if key in wanted):
        for coder in _coders():
            _coded_row(evaluation, key, coder)
    for key in (key for key in PHOTO_ROWS if key in wanted or key == "lod0"):
        _photo_row(evaluation, key, *PHOTO_ROWS[key])
    for key in (key for key in PICTURE_ROWS if key in wanted):
        _picture_row(evaluation, key)
    _per_splat_row(evaluation)
    document = _document(evaluation, wanted) | {"atoms": _figure_9(evaluation)}
    document |= _pictures(evaluation, out) if render else {"close_ups": [], "passes": []}
    document["held_out"] = _held_out(evaluation, out, hold_out) if hold_out and render else None
    return document


# --- Table 1 ----------------------------------------------------------------------------------------------------------


def _coders() -> tuple[str, ...]:
    """All coders there are to choose from, the published one first."""
    return BY_NAME["coder"].choices if "coder" in BY_NAME else ("",)


def _average_row(e: _Evaluation) -> None:
    """Splats of one colour; the geometry of all rows is this one's."""
    _coded_row(e, "average", "", max_atoms=0)
    e.rows["average"] |= {"name": "average colour", "coder": "none"}


def _coded_row(e: _Evaluation, key: str, coder: str, **changes) -> None:
    if key in CODED_ROWS:
        changes |= dict(zip(("dictionary_bits", "weight_bits"), CODED_ROWS[key]))
    settings = replace(e.settings, **changes, **({"coder": coder} if coder else {}))
    n_before = len(e.run.records)
    coded = code_prepared(e.run, e.prepared, e.patches, settings)
    seconds = sum(record.made_seconds for record in e.run.records[n_before:])
    name = f"{key}-{coder}" if coder else key
    path = e.out / (name + SUFFIX)
    pack(e.run, e.prepared, coded, settings, e.scan.stem, path)
    with PackedFile(path) as packed:
        sizes = sizes_of(packed.load(), path.stat().st_size)
    quality = coded.codes.summary
    e.rows[name] = _row(e, key.upper(), coder or "k-SVD", sizes["gpu_bytes"] - sizes["geometry_bytes"], quality, seconds,
                        sizes["geometry_bytes"]) | {
        "kind": "ours", "n_dictionary": coded.n_dictionary, "mean_atoms": quality["mean_atoms"],
        "file_bytes": sizes["file_bytes"], "learning": coded.learning}
    e.coded[name], e.packed[name] = coded, path


def _photo_row(e: _Evaluation, key: str, lod: int, codec: str, bytes_per_pixel: float | None = None) -> None:
    variant = e.run.do(PhotoVariant(e.prepared.photos, lod, codec, bytes_per_pixel))
    errors = e.run.do(VariantErrors(variant.folder, e.prepared.partition.folder, e.prepared.splats.folder, e.patches.folder,
                                    e.prepared.radius, *directions_of(e.prepared.scan.summary["cameras"])))
    kind = CODECS[codec]
    name = kind.title if not kind.renderable else f"photos LOD {lod}" + (f" {kind.title}" if codec != "raw" else "")
    e.rows[key] = _row(e, name, kind.encoder, variant.summary["bytes"], errors.summary, variant.made_seconds) | {
        "kind": "photos" if kind.renderable else "pictures"}
    if kind.renderable:
        e.photos[key] = variant.folder


def _picture_row(e: _Evaluation, codec: str) -> None:
    """At the bytes of our textures: of the first coded row, or of BC1 at LOD 1 where there is none."""
    coded = next((row for row in e.rows.values() if row["kind"] == "ours" and row.get("n_dictionary")), None)
    cameras = e.prepared.scan.summary["cameras"]
    n_pixels = sum(c["width_px"] * c["height_px"] for c in cameras)
    _photo_row(e, codec, 0, codec, coded["texture_bytes"] / n_pixels if coded else 1 / 6)


def _per_splat_row(e: _Evaluation) -> None:
    """One texture a splat, as in an atlas: what our patches are before they are coded."""
    n_bytes = e.n_splats * texture_bytes(PATCH_SIZE, PATCH_SIZE, lambda w, h: 3 * w * h)
    e.rows["per-splat"] = _row(e, "one texture a splat", "none", n_bytes, dict.fromkeys(("texture_psnr_db", "visible_psnr_db")),
                               e.patches.made_seconds) | {"kind": "atlas"}


def _row(e: _Evaluation, name: str, coder: str, n_bytes: int, quality: dict, seconds: float, geometry: int | None = None) -> dict:
    geometry = geometry or e.rows["average"]["geometry_bytes"]
    return {"name": name, "coder": coder, "texture_bytes": int(n_bytes), "geometry_bytes": int(geometry),
            "bytes_per_splat": (n_bytes + geometry) / e.n_splats, "texture_psnr_db": quality["texture_psnr_db"],
            "visible_psnr_db": quality["visible_psnr_db"], "seconds": seconds, "n_dictionary": None, "mean_atoms": None,
            "file_bytes": None, "learning": []}


def _document(e: _Evaluation, wanted: list[str]) -> dict:
    """The rows in the paper's order, with their factors against the photographs as they are."""
    raw = e.rows["lod0"]
    shown = []
    for key in ROWS:
        for name, row in e.rows.items():
            if key in wanted and (name == key or name.startswith(key + "-") and key in CODED_ROWS):
                factors = {"factor_total": (raw["texture_bytes"] + raw["geometry_bytes"]) / (row["texture_bytes"] + row["geometry_bytes"]),
                           "factor_texture": raw["texture_bytes"] / row["texture_bytes"]}
                shown.append({"key": name} | row | factors)
    summary = e.prepared.scan.summary
    return {"scan": {"name": e.scan.resolve().name, "format": summary["format"], "n_cameras": len(summary["cameras"])},
            "splats": e.n_splats, "radius": e.prepared.radius, "resampling_psnr_db": e.patches.summary["resampling_psnr_db"],
            "rows": shown, "target_psnr_db": e.settings.target_psnr_db, "n_workers": e.run.executor.n_workers}


# --- figures and pictures ---------------------------------------------------------------------------------------------


def _figure_9(e: _Evaluation) -> dict | None:
    """How many splats of a random sample have how many atoms, by target quality, with the largest dictionary here."""
    with_dictionary = [(name, coded) for name, coded in e.coded.items() if coded.quantized]
    if not with_dictionary:
        return None
    name, coded = max(with_dictionary, key=lambda pair: pair[1].n_dictionary)
    sample = e.run.do(PatchSample(e.patches.folder, coded.colors.folder, FIGURE_9_SPLATS))
    settings = replace(e.settings, **({"coder": "paper"} if "coder" in BY_NAME else {}))
    shares = [encode(e.run, sample.folder, sample.folder, coded.quantized, replace(settings, target_psnr_db=float(target))).summary["histogram"]
              for target in FIGURE_9_TARGETS_DB]
    return {"row": name, "n_splats": sample.summary["n_splats"], "targets_db": list(FIGURE_9_TARGETS_DB), "histograms": shares}


def _variants(e: _Evaluation) -> list[Variant]:
    """What the close-ups show and the passes are timed with: photographs as textures, then ours."""
    shown = []
    for key, folder in e.photos.items():
        shown.append(Variant(e.rows[key]["name"], e.packed["average"], folder))
    return shown + [Variant(f"{e.rows[key]['name']} {e.rows[key]['coder']}", path) for key, path in e.packed.items()]


def _pictures(e: _Evaluation, out: Path) -> dict:
    chosen = next((name for name in e.packed if name != "average"), "average")
    variants = _variants(e)
    begun = time.perf_counter()
    e.run.progress.begin("pictures", 2)
    close_ups = e.run.paint(draw_close_ups, variants, e.packed[chosen], e.prepared.photos, out)
    e.run.progress.advance("pictures", 1, 0)
    passes = e.run.paint(time_passes, [v for v in variants if v.photos is None or v.name in ("photos LOD 0", "photos LOD 1")])
    e.run.progress.end(StageRecord("pictures", out, {}, time.perf_counter() - begun, 0, 2, 0, False))
    return {"close_ups": close_ups, "passes": passes, "close_ups_of": chosen}


def _held_out(e: _Evaluation, out: Path, every: int) -> dict | None:
    """The file made without every N-th photograph, seen from their cameras."""
    names = [c["name"] for c in e.prepared.scan.summary["cameras"]]
    chosen = tuple(range(0, len(names), every))
    if len(chosen) == len(names):
        raise InvalidScan(str(e.scan), f"{len(names)} photographs, each of them held out", "--hold-out so large that some are left")
    prepared = prepare(e.run, e.scan, e.settings.radius, e.settings.effects, chosen, e.settings.density)
    coded = code(e.run, prepared, e.settings)
    path = e.out / f"held-out{SUFFIX}"
    pack(e.run, prepared, coded, e.settings, e.scan.stem, path)
    views = compare_held_out(HeldOut(path, prepared.photos, chosen), out)
    return {"every": every, "n_photos": len(names), "n_uncoloured": prepared.splats.summary["n_without_camera"], "views": views}
