"""`report`: a packed file measured against its scan's photographs once more."""

from __future__ import annotations

import tempfile
from pathlib import Path

from msgspec import UNSET

from pipeline.effects.exposure import exposed
from pipeline.execution.stage import Executor, Progress
from pipeline.planning.settings import settings_for
from pipeline.stages.packed.measure import Measure, ingest_fits
from pipeline.volumes.open import is_volume
from pipeline.volumes.request import SurfaceRequest
from renderer.report.document import HardCases, Quality, RunRecord, ScanKnown
from services.flow.fingerprint import fingerprint
from services.flow.outputs import write_outputs
from services.flow.points.read import ingest_of
from services.flow.points.volumes import surface_points, surface_request
from services.flow.run import Run
from storage.errors import InvalidScan
from storage.packed.packed import PackedFile


def report(packed: Path, scan: Path, out: Path, executor: Executor, progress: Progress, *, render: bool = True) -> dict:
    """Measure a packed file against the scan's photographs, and write previews and report into `out`."""
    with PackedFile(packed) as opened:
        header = opened.header
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".work.", dir=out) as work:
        run = Run(Path(work), executor, progress)
        quality, n_flagged = Quality(), None
        ingest = surface_points(run, scan, _surface(header.settings)) if is_volume(scan) else ingest_of(run, scan)
        if not ingest_fits(ingest.folder, [c.name for c in header.cameras]):
            raise InvalidScan(
                str(scan),
                f"photographs {[c.name for c in ingest.summary.cameras][:3]}...",
                f"those that {packed.name} was made from, {[c.name for c in header.cameras][:3]}...",
            )
        photos = ingest.folder
        if "exposure" in header.effects and header.cameras:
            photos = run.do(exposed(ingest.folder, header.effects["exposure"])).folder
        if header.cameras:
            measured = run.do(Measure(photos, packed.resolve(), fingerprint(packed))).summary
            n_flagged = measured.n_flagged
            quality = Quality(measured.texture_psnr_db, measured.visible_psnr_db, measured.resampling_psnr_db)
        read = ingest.summary
        record = RunRecord(
            scan=ScanKnown(n_cameras=len(header.cameras), warnings=read.warnings, volume=read.volume or UNSET),
            quality=quality,
            numerics=HardCases(dropped_points=read.n_dropped, flagged_projections=n_flagged),
        )
        return write_outputs(run, packed, photos, record, out, render)


def _surface(settings: dict) -> SurfaceRequest:
    """What a packed file's settings asked of its volume; what they do not say, or not rightly, as by default."""
    names = ("iso", "cell", "resampling", "border", "spacing", "component", "time")
    try:
        return surface_request(settings_for(**{name: settings.get(name) for name in names}))
    except ValueError:
        return SurfaceRequest()
