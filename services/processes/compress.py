"""`compress`: from a scan to a packed file, its previews and its report."""

from __future__ import annotations

import shutil
from dataclasses import asdict, replace
from pathlib import Path

from msgspec import UNSET

from pipeline.effects.plan.plan import Row
from pipeline.execution.stage import Executor, Progress
from pipeline.planning.settings import Settings
from pipeline.readers.files.spelling import shown
from renderer.report.document import (
    EstimatedFigure,
    GeometryErrors,
    HardCases,
    Quality,
    RunRecord,
    ScanKnown,
)
from renderer.report.report import sizes_from, sizes_of
from services.flow.asked import prepare_asked
from services.flow.beside import Beside, make_beside
from services.flow.budget import check_budget
from services.flow.code import Texture, texture
from services.flow.estimate_cache import against, known_estimate
from services.flow.outputs import write_outputs
from services.flow.pack import pack, packed_gpu_bytes, write_packed
from services.flow.points.runs import runs_report
from services.flow.prepare import Prepared, has_photographs
from services.flow.run import Run
from services.flow.textures import Coded
from storage.packed.levels import FEWER
from storage.packed.packed import SUFFIX, PackedFile
from storage.packed.schema import BOXES, GROUP, RUNS
from storage.pages.file import SUFFIX as PAGES_SUFFIX
from storage.whole import placed_whole
from storage.work import arrays


def compress(
    scan: Path,
    out: Path,
    settings: Settings,
    executor: Executor,
    progress: Progress,
    *,
    render: bool = True,
    work: Path | None = None,
    strict: bool = False,
    edited_maps: Path | None = None,
) -> dict:
    """Compress a scan into `out`: NAME.splatpress, report.json, report.html and previews/, and NAME.pages where the
    plan has pages on. Returns the report.

    `out` appears with all of it, or not at all; only where the packed file is whole and its pictures or its report
    fail, `out` appears with what there is, and the error says so in a note. With `work` the outputs of the stages stay
    there and are used again; else they are thrown away. `edited_maps` is a folder that `map` wrote, whose pictures
    somebody edited. Raises InvalidScan for a warning about the scan if `strict`.
    """
    failed: Exception | None = None
    report: dict = {}
    with placed_whole(out) as made:
        run = Run(work or made / "work", executor, progress, strict=strict, keeps_work=work is not None)
        try:
            report = make(run, scan, settings, made, render, edited_maps=edited_maps)
        except Exception as error:
            packed = next(made.glob(f"*{SUFFIX}"), None)
            if packed is None:
                raise
            error.add_note(f"the packed file is whole and was kept: {out / packed.name}")
            failed = error
        if work is None:
            shutil.rmtree(made / "work")
    if failed is not None:
        raise failed
    return report


def make(
    run: Run,
    scan: Path,
    settings: Settings,
    out: Path,
    render: bool = True,
    name: str | None = None,
    edited_maps: Path | None = None,
) -> dict:
    """All of a job, into the folder `out`, which is there; the packed file is called `name`, else as the scan.
    Returns the report."""
    name = name or shown(scan.resolve().name.removesuffix(".zip") if scan.is_dir() else scan.stem)
    path = out / (name + SUFFIX)
    prepared = prepare_asked(run, scan, settings, edited_maps=edited_maps)
    textured = texture(run, prepared, settings)
    packed = pack(run, prepared, textured.coded, settings, name, None, textured.mapped)
    if settings.budget_bytes is not None:
        check_budget(settings.budget_bytes, prepared.splats.summary.n_splats, packed_gpu_bytes(packed))
    write_packed(run, packed, path, settings.archive == "on")
    beside = make_beside(run, prepared, settings, path.with_suffix(PAGES_SUFFIX))
    return finish(run, path, prepared, textured, settings, out, render, beside)


def finish(
    run: Run,
    path: Path,
    prepared: Prepared,
    textured: Texture,
    settings: Settings,
    out: Path,
    render: bool,
    beside: Beside = Beside(None, {}),
) -> dict:
    """Previews and report of a packed file, and of what is beside it, just made."""
    coded = textured.coded
    record = RunRecord(
        scan=_scan_record(prepared, settings),
        quality=_quality(prepared, textured),
        learning=coded.learning if coded else (),
        numerics=_numerics(prepared, coded),
        settings=asdict(settings),
        effects=tuple(_with_choice(row, textured) for row in prepared.effects.rows),
        estimate=_estimate(run, path, textured, settings, beside),
        runs=runs_report(prepared.runs, path) if prepared.runs is not None else None,
        pages=beside.pages,
        found=beside.found or UNSET,
    )
    return write_outputs(run, path, prepared.photos, record, out, render, prepared.maps)


def _with_choice(row: Row, textured: Texture) -> Row:
    """The row of station maps says besides whether atoms or maps, and why."""
    return replace(row, choice=textured.choice) if row.effect == "station_maps" else row


def _estimate(
    run: Run, path: Path, textured: Texture, settings: Settings, beside: Beside
) -> dict[str, EstimatedFigure] | None:
    """What was estimated for this job, beside what happened up to its packed file, in stages run now or before."""
    estimate = known_estimate(run.work, settings)
    if estimate is None:
        return None
    with PackedFile(path, verify=False) as packed:
        header = packed.header
        sizes = sizes_of(packed.load(), 0) if header.runs else sizes_from(header, packed.totals().bytes, 0)
    return against(
        estimate,
        {
            "seconds": sum(r.made_seconds for r in run.records),
            "peak_memory_bytes": max(r.peak_rss_bytes for r in run.records),
            "gpu_bytes": sizes.gpu_bytes,
            "file_bytes": packed.n_bytes,
            "texture_psnr_db": textured.psnr_db,
            "pages_bytes": beside.pages.bytes if beside.pages else None,
        },
    )


def _scan_record(prepared: Prepared, settings: Settings) -> ScanKnown:
    scan = prepared.scan.summary
    warnings = list(scan.warnings)
    n_bad, n_splats = prepared.neighbours.summary.n_degenerate, prepared.splats.summary.n_splats
    if n_bad:
        warnings.append(
            f"{n_bad:,} of {n_splats:,} splats have no normal of the scan's, and none that their neighbourhood defines"
        )
    if not (scan.has_colors or scan.cameras):
        warnings.append(
            "the scan has neither colours nor intensity nor photographs; its splats are grey, lit by "
            + ("its normals" if arrays.exists(prepared.scan.folder, "normal") else "normals that were estimated")
        )
    n_blind = prepared.splats.summary.n_without_camera
    if scan.cameras and n_blind:
        warnings.append(f"{n_blind:,} of {n_splats:,} splats are seen by no camera and have the scan's colour")
    if "pages" in prepared.effects.enabled and not (has_photographs(prepared) or prepared.maps):
        warnings.append(
            "pages are asked for, and there are none: the scan has neither photographs nor maps of stations"
        )
    if settings.dictionary == "shipped" and not (has_photographs(prepared) or prepared.maps):
        warnings.append("dictionary shipped is not used: nothing in the scan is coded by atoms")
    if prepared.runs is not None and settings.levels:
        warnings.append(f"levels {settings.levels} is not used: runs have no coarser levels")
    n_coarser = max(0, len(prepared.partition.summary.levels) - 1)
    if prepared.runs is None and settings.levels and n_coarser < settings.levels:
        warnings.append(
            f"levels {settings.levels} is more than there are: of {n_splats:,} splats {n_coarser}, each of {FEWER * GROUP:,} or more of the next"
        )
    if prepared.runs is None and scan.volume is None and settings.cell is not None and settings.geometry == BOXES:
        warnings.append(f"cell {settings.cell:g} is not used: boxes of a scan have no cells")
    if prepared.runs is not None and settings.archive == "on":
        warnings.append("archive on is not used: runs are coded already")
    for name in ("geometry_error", "normal_error"):
        known, asked = name == "normal_error" or settings.geometry in (BOXES, RUNS), getattr(settings, name)
        if asked is not None and known and prepared.quadric_error is None:
            warnings.append(f"{name} {asked:g} is not used: it is of quadrics")
    return ScanKnown(
        unit=scan.unit,
        n_points=scan.n_read,
        n_cameras=len(scan.cameras),
        warnings=tuple(warnings),
        unused=scan.unused,
        volume=scan.volume or UNSET,
    )


def _numerics(prepared: Prepared, coded: Coded | None) -> HardCases:
    """The hard cases that were met, counted."""
    scan = prepared.scan.summary
    blind = prepared.splats.summary.n_without_camera if scan.cameras else 0
    return HardCases(
        dropped_points=scan.n_dropped,
        degenerate_normals=prepared.neighbours.summary.n_degenerate,
        flagged_projections=coded.patches.summary.n_flagged if coded else blind,
        replaced_atoms=sum(row.replaced_atoms for row in coded.learning) if coded else 0,
        safeguard_steps=coded.safeguard_steps if coded else 0,
    )


def _quality(prepared: Prepared, textured: Texture) -> Quality:
    splats = prepared.splats.summary
    position, normal = splats.mean_position_error, splats.mean_normal_error_degrees
    in_radii = splats.mean_error_in_radii
    if prepared.runs is not None:
        position = prepared.runs.cells.summary.mean_error
        in_radii = position / prepared.radius
        normal = prepared.runs.codes.summary.mean_normal_error_degrees
    geometry = GeometryErrors(position, in_radii, normal)
    coded = textured.coded
    if coded is None:
        return Quality(textured.psnr_db, geometry=geometry)
    codes, patches = coded.codes.summary, coded.patches.summary
    return Quality(codes.texture_psnr_db, codes.visible_psnr_db, patches.resampling_psnr_db, geometry)
