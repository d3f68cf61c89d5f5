"""The evaluation of HPG 2021, section 4, on any scan with photographs: what each way to keep its textures costs and
loses."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from msgspec import structs

from pipeline.execution.stage import Executor, Progress, StageRecord
from pipeline.planning.settings import Settings
from pipeline.stages.pages.coded import FILE, PageForm
from pipeline.stages.pages.photo_pages import PhotoPages
from pipeline.stages.texture.patch_sample import PatchSample
from pipeline.summaries import Photographs
from renderer.evaluate.close_ups import Variant, draw_close_ups, time_passes
from renderer.evaluate.held_out import HeldOut, compare_held_out
from renderer.evaluate.picture_psnr import picture_psnrs
from renderer.report.evaluation_document import AtomsByTarget, EvaluationDocument, Failure, HeldOutPhotos
from renderer.splats.baseline import PHOTO_BUDGET_BYTES, texture_bytes
from services.flow.asked import prepare_asked
from services.flow.code import code, resample
from services.flow.pack import pack
from services.flow.prepare import Prepared, has_photographs
from services.flow.run import Run
from services.flow.textures import encode
from services.processes.evaluated_rows import (
    CODED_ROWS,
    PHOTO_ROWS,
    PICTURE_ROWS,
    ROWS,
    Evaluation,
    average_row,
    coded_name,
    coded_row,
    coders,
    document_of,
    per_splat_row,
    photo_row,
    picture_row,
)
from storage.errors import InvalidScan, SplatpressError
from storage.packed.packed import SUFFIX
from storage.whole import aside, put_in_place
from storage.work import work as work_folder

FIGURE_9_TARGETS_DB = tuple(range(28, 49, 2))
FIGURE_9_SPLATS = 16_384
PAGED = PageForm("png")  # of photographs that exceed the pool: what is compared with has lost nothing


def evaluate(
    scan: Path,
    out: Path,
    settings: Settings,
    executor: Executor,
    progress: Progress,
    *,
    rows: Iterable[str] = ROWS,
    hold_out: int | None = None,
    render: bool = True,
    work: Path | None = None,
    pool_bytes: int = PHOTO_BUDGET_BYTES,
) -> EvaluationDocument:
    """Measure the chosen rows of Table 1 and what the figures need; writes evaluate.json and evaluate.html into `out`.

    `settings` are those of the coded rows, but for the bits that name them. With `hold_out` every N-th photograph is
    kept out of texturing and compared with.

    `out` appears with the first row, and is written anew, each file whole, with every row and figure that follows: what
    has been measured stays, whatever happens after. A row or a figure that fails is named under `failed`, with its
    error, and takes no other with it; only without the average colour, whose geometry all rows share, are there none.
    Photographs that take more than `pool_bytes` on the GPU are drawn by pages in a pool of that size, none of them
    missing.

    Raises: InvalidScan for a scan without photographs, and where `hold_out` leaves none.
    """
    with aside(out) as made:
        run = Run(work or made / "work", executor, progress)
        return _measure(run, scan, out, made, settings, list(rows), hold_out, render, pool_bytes)


def _measure(
    run: Run,
    scan: Path,
    out: Path,
    beside: Path,
    settings: Settings,
    wanted: list[str],
    hold_out: int | None,
    render: bool,
    pool_bytes: int,
) -> EvaluationDocument:
    prepared = prepare_asked(run, scan, settings)
    if not has_photographs(prepared):
        raise InvalidScan(
            str(scan),
            "no photograph that sees any of its points",
            "a scan with photographs: there is no texture to evaluate",
        )
    held_out = _held_out_photos(scan, prepared, hold_out) if hold_out and render else ()
    packed = beside / "packed"
    packed.mkdir()
    e = Evaluation(run, scan, packed, settings, prepared, resample(run, prepared), pool_bytes=pool_bytes)
    average_row(e)
    _begin(beside / "out", out, document_of(e, wanted))

    def attempt(name: str, step: Callable, *arguments) -> None:
        _attempt(e, name, step, *arguments)
        _write(out, document_of(e, wanted))

    attempt("lod0", photo_row, e, "lod0", *PHOTO_ROWS["lod0"])
    for key in (key for key in CODED_ROWS if key in wanted):
        for coder in coders():
            attempt(coded_name(key, coder), coded_row, e, key, coder)
    for key in (key for key in PHOTO_ROWS if key in wanted and key != "lod0"):
        attempt(key, photo_row, e, key, *PHOTO_ROWS[key])
    for key in (key for key in PICTURE_ROWS if key in wanted):
        attempt(key, picture_row, e, key)
    attempt("per-splat", per_splat_row, e)
    attempt("Figure 9", _figure_9, e)
    if render:
        attempt("close-ups and passes", _pictures, e, out)
    if held_out:
        attempt("photographs held out", _held_out, e, out, hold_out, held_out)
    _write(out, document := document_of(e, wanted, complete=True))
    return document


def _begin(made: Path, out: Path, document: EvaluationDocument) -> None:
    """`out` with the first row; an older `out` goes only now."""
    made.mkdir()
    _write(made, document)
    put_in_place(made, out)


def _attempt(e: Evaluation, name: str, step: Callable, *arguments) -> None:
    """One row, or figure; its failure is kept, and told at the end."""
    try:
        step(*arguments)
    except Exception as error:
        traceback.print_exc()
        kind = (
            error.kind
            if isinstance(error, SplatpressError)
            else "resource"
            if isinstance(error, OSError)
            else "internal"
        )
        e.failed.append(Failure(name, kind, f"{type(error).__name__}: {error}"))


def _figure_9(e: Evaluation) -> None:
    """How many splats of a random sample have how many atoms, by target quality, with the largest dictionary here of
    the published coder: the default one's atoms are no patches, and it has a multiplier in place of a cut-off."""
    of_paper = [(name, coded) for name, coded in e.coded.items() if coded.quantised and e.rows[name].coder == "paper"]
    if not of_paper:
        return
    name, coded = max(of_paper, key=lambda pair: pair[1].n_dictionary)
    sample = e.run.do(PatchSample(e.patches.folder, coded.colors.folder, FIGURE_9_SPLATS))
    settings = replace(e.settings, coder="paper")
    shares = [
        encode(
            e.run, sample.folder, sample.folder, coded.quantised, replace(settings, target_psnr_db=float(target))
        ).summary.histogram
        for target in FIGURE_9_TARGETS_DB
    ]
    e.atoms = AtomsByTarget(name, sample.summary.n_splats, FIGURE_9_TARGETS_DB, tuple(shares))


def _write(out: Path, document: EvaluationDocument) -> None:
    """evaluate.json and its page in `out`."""
    from renderer.report.evaluation_page import write_evaluation  # bokeh takes half a second to import

    write_evaluation(out, document)


def _variants(e: Evaluation) -> list[Variant]:
    """What the close-ups show and the passes are timed with: photographs as textures, then ours."""
    shown = []
    for key, folder in e.photos.items():
        shown.append(Variant(e.rows[key].name, e.packed["average"], folder, _pages_of(e, folder), e.pool_bytes))
    return shown + [Variant(f"{e.rows[key].name} {e.rows[key].coder}", path) for key, path in e.packed.items()]


def _pages_of(e: Evaluation, folder: Path) -> Path | None:
    """A page file of the photographs of a folder, without loss, where they exceed the pool; None where they fit."""
    if texture_bytes(work_folder.summary(folder, Photographs).cameras) <= e.pool_bytes:
        return None
    return e.run.do(PhotoPages(folder, PAGED)).folder / FILE


def _pictures(e: Evaluation, out: Path) -> None:
    chosen = next((name for name in e.packed if name != "average"), "average")
    variants = _variants(e)
    begun = time.perf_counter()
    e.run.progress.begin("pictures", 3)
    psnrs = e.run.paint(picture_psnrs, variants, e.prepared.photos)
    for key, psnr in zip([*e.photos, *e.packed], psnrs, strict=True):
        e.rows[key] = structs.replace(e.rows[key], picture_psnr_db=psnr)
    e.run.progress.advance("pictures", 1, 0)
    close_ups = e.run.paint(draw_close_ups, variants, e.packed[chosen], e.prepared.photos, out)
    e.run.progress.advance("pictures", 1, 0)
    passes = e.run.paint(
        time_passes, [v for v in variants if v.photos is None or v.name in ("photos LOD 0", "photos LOD 1")]
    )
    e.run.progress.end(StageRecord("pictures", out, None, time.perf_counter() - begun, 0, 3, 0, False))
    e.close_ups, e.passes, e.close_ups_of = tuple(close_ups), tuple(passes), chosen


def _held_out_photos(scan: Path, prepared: Prepared, every: int) -> tuple[int, ...]:
    n_photos = len(prepared.scan.summary.cameras)
    chosen = tuple(range(0, n_photos, every))
    if len(chosen) == n_photos:
        raise InvalidScan(
            str(scan), f"{n_photos} photographs, each of them held out", "--hold-out so large that some are left"
        )
    return chosen


def _held_out(e: Evaluation, out: Path, every: int, chosen: tuple[int, ...]) -> None:
    """The file made without every N-th photograph, seen from their cameras."""
    prepared = prepare_asked(e.run, e.scan, e.settings, chosen)
    coded = code(e.run, prepared, e.settings)
    path = e.out / f"held-out{SUFFIX}"
    pack(e.run, prepared, coded, e.settings, e.scan.stem, path)
    views = compare_held_out(HeldOut(path, prepared.photos, chosen), out)
    n_photos = len(e.prepared.scan.summary.cameras)
    e.held_out = HeldOutPhotos(every, n_photos, prepared.splats.summary.n_without_camera, tuple(views))
