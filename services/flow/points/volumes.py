"""From a volume to the points of its iso-surfaces: what an ingest is to a scan."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

from pipeline.execution.stage import StageRecord
from pipeline.planning.settings import Settings
from pipeline.stages.volumes.iso_surface import IsoSurface
from pipeline.stages.volumes.iso_values import IsoProposed, IsoValues
from pipeline.stages.volumes.voxels import Voxels
from pipeline.summaries import ScanRead, VolumeRead
from pipeline.volumes.open import open_volume
from pipeline.volumes.request import PALETTE, Iso, SurfaceRequest, parse_isos
from pipeline.volumes.volume import Choice
from services.flow.fingerprint import fingerprint, located
from services.flow.run import Run
from storage import place
from storage.errors import InvalidScan, UnsupportedScan


def surface_request(settings: Settings) -> SurfaceRequest:
    """What settings say of a volume."""
    return SurfaceRequest(
        parse_isos(settings.iso), settings.cell, settings.resampling, settings.border, settings.choice
    )


def voxels_of(run: Run, path: Path, choice: Choice) -> StageRecord[VolumeRead]:
    """Read the volume."""
    return run.do(Voxels(located(path), _fingerprint(path, choice), choice))


def iso_values_of(run: Run, path: Path, choice: Choice) -> tuple[StageRecord[VolumeRead], StageRecord[IsoProposed]]:
    """Read the volume, and see which iso values it proposes."""
    voxels = voxels_of(run, path, choice)
    return voxels, run.do(IsoValues(voxels.folder))


def surface_points(run: Run, path: Path, asked: SurfaceRequest, on_cells: bool = False) -> StageRecord[ScanRead]:
    """The points of the surfaces asked for, or of the one that the volume proposes first; `on_cells` at the centres of
    their cells.

    Raises: InvalidScan where it proposes none.
    """
    if asked.isos:
        voxels, isos, labels = voxels_of(run, path, asked.choice), asked.isos, False
    else:
        voxels, values = iso_values_of(run, path, asked.choice)
        proposals = values.summary.proposals
        if not proposals:
            found = (
                f"all voxels are {voxels.summary.low:g}"
                if voxels.summary.low == voxels.summary.high
                else "no value that voxels pass steeply"
            )
            raise InvalidScan(str(path), found, "values that differ", "give one with --iso")
        isos, labels = (Iso(proposals[0].iso, PALETTE[0]),), values.summary.is_labels
    return run.do(
        IsoSurface(voxels.folder, isos, asked.cell, asked.method, asked.border, not asked.isos, on_cells, labels)
    )


def refuse_surfaces(scan: Path, asked: SurfaceRequest) -> None:
    """Raises UnsupportedScan where surfaces of a volume are asked of points."""
    if replace(asked, cell=None) != SurfaceRequest():
        raise UnsupportedScan(
            str(scan),
            "points, with settings of a volume",
            "iso, resampling, border, spacing, component and time for volumes only",
        )


def _fingerprint(path: Path, choice: Choice) -> str:
    """A hash of the sizes and times of all the files that a volume is read from."""
    if path.is_dir() or place.is_remote(path):
        return fingerprint(path)
    files = map(Path, open_volume(path, choice).files)
    return hashlib.sha256("\n".join(fingerprint(file) for file in files).encode()).hexdigest()
