"""Reading a scan, or the surfaces of a volume, and putting its points in chunk order."""

from __future__ import annotations

from pathlib import Path

from pipeline.execution.stage import StageRecord
from pipeline.readers.attributes.options import ReadOptions
from pipeline.stages.points.grid_counts import IN_MEMORY, GridCounts
from pipeline.stages.points.ingest import Ingest
from pipeline.stages.points.kept import n_kept
from pipeline.stages.points.leaves import DealtLeaves
from pipeline.stages.points.partition import Partition
from pipeline.stages.points.thin import Thin
from pipeline.summaries import Points, ScanRead
from pipeline.volumes.open import is_volume
from pipeline.volumes.request import SurfaceRequest
from services.flow.fingerprint import fingerprint, located
from services.flow.points.volumes import refuse_surfaces, surface_points
from services.flow.run import Run
from storage.errors import InvalidScan


def ingest_of(run: Run, scan: Path, reading: ReadOptions = ReadOptions()) -> StageRecord[ScanRead]:
    """Read the scan; where all of its points say otherwise of it than those that were sampled, once more.

    Raises: InvalidScan for a warning about the scan where the run is strict.
    """
    path, files = located(scan), fingerprint(scan)
    ingest = run.do(Ingest(path, files, reading))
    if ingest.summary.seen:
        ingest = run.do(Ingest(path, files, reading, ingest.summary.seen))
    if run.strict and ingest.summary.warnings:
        raise InvalidScan(str(scan), "; ".join(ingest.summary.warnings), "no warnings, with --strict")
    return ingest


def points_of(
    run: Run,
    scan: Path,
    density: float = 1.0,
    surface: SurfaceRequest = SurfaceRequest(),
    reading: ReadOptions = ReadOptions(),
    on_cells: bool = False,
) -> tuple[StageRecord[ScanRead], StageRecord[Points]]:
    """Read the scan or the surfaces of a volume, and put its points in chunk order, or that share of them; `on_cells`
    leaves those of a volume at the centres of their cells."""
    if is_volume(scan):
        ingest = surface_points(run, scan, surface, on_cells)
    else:
        refuse_surfaces(scan, surface)
        ingest = ingest_of(run, scan, reading)
    return ingest, in_chunk_order(run, ingest, density)


def in_chunk_order(run: Run, ingest: StageRecord[ScanRead], density: float) -> StageRecord[Points]:
    """That share of the points of a scan, in chunk order."""
    thinned = run.do(Thin(ingest.folder, density)).folder if density < 1 else None
    if n_kept(ingest.folder, thinned) <= IN_MEMORY:
        return run.do(Partition(ingest.folder, thinned))
    counts = run.do(GridCounts(ingest.folder, thinned))
    if counts.summary.n_leaves == 1:
        return run.do(Partition(ingest.folder, thinned))
    dealt = run.do(DealtLeaves(ingest.folder, counts.folder, thinned))
    return run.do(Partition(ingest.folder, thinned, counts.folder, dealt.folder))
