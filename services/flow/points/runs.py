"""The geometry of a scan's splats as runs in a hexagonal close packed grid, where it is asked for or fewer bytes at the asked error."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import ZipFile

from pipeline.effects.plan.plan import EffectPlan, Row, with_reason
from pipeline.effects.plan.request import OFF, canonical_request
from pipeline.execution.stage import StageRecord
from pipeline.planning.settings import Settings
from pipeline.stages.runs.found import CellsAsPoints, CellsFilled, GridFound, RunsCoded
from pipeline.summaries import Points, ScanRead, Spacings
from renderer.report.document import RunBits, RunsMade
from services.flow.run import Run
from storage.packed.schema import BOXES, CHUNK, RUNS
from storage.work import work

AUTO = "auto"
BOX_BITS = 24 + 16 + 8 * 28 / CHUNK  # of a point in boxes, on a graphics card: docs/FORMAT.md, Size

NO_PLACE = {"ellipsoids": "runs have none: ellipsoids lie beside the cells", "levels": "runs have no coarser levels"}


@dataclass(frozen=True)
class GeometryRequest:
    """What a job says of geometry. With AUTO a `cell` is the error that is asked for: at most cell / sqrt(2)."""

    form: str = BOXES
    cell: float | None = None
    run_length: int = Settings().run_length
    error: float | None = None  # mean one of positions over quadrics, in radii
    normal_error: float | None = None  # the same of normals, in degrees


@dataclass(frozen=True)
class RunGeometry:
    """The stages that made runs."""

    grid: StageRecord[GridFound]
    cells: StageRecord[CellsFilled]
    codes: StageRecord[RunsCoded]
    points: StageRecord[CellsAsPoints]
    run_length: int


def geometry_request(settings: Settings) -> GeometryRequest:
    """What settings say of it."""
    s = settings
    return GeometryRequest(s.geometry, s.cell, s.run_length, s.geometry_error, s.normal_error)


def grid_for(run: Run, asked: GeometryRequest, ingest: ScanRead, points: Path, splats: Path) -> StageRecord[GridFound]:
    """The grid of a scan's runs; of a volume its own."""
    from pipeline.stages.runs.grid import RunGridChoice  # loops that compile: for runs alone

    turn = ingest.grid.turn if ingest.grid else None
    cell = ingest.volume.cell if ingest.grid and ingest.volume else asked.cell
    return run.do(RunGridChoice(points, splats, asked.run_length, cell, turn))


def runs_of_splats(
    run: Run,
    asked: GeometryRequest,
    grid: StageRecord[GridFound],
    points: Path,
    neighbours: Path,
    splats: Path,
    of_volume: bool,
) -> RunGeometry:
    """Cells, codes and decoded points of splats that were made as boxes, which tell how normals are turned. Gaps `of_volume` stay: that no
    cell of a surface lies there is known, of a scan it may be chance."""
    from pipeline.stages.runs.cells import RunCells
    from pipeline.stages.runs.codes import RunCoding
    from pipeline.stages.runs.points import RunPoints

    cells = run.do(RunCells(points, splats, grid.folder, asked.run_length, closing=not of_volume))
    codes = run.do(RunCoding(cells.folder, grid.folder))
    made = run.do(RunPoints(points, neighbours, cells.folder, codes.folder, grid.summary.cell))
    return RunGeometry(grid, cells, codes, made, asked.run_length)


def is_worth_it(asked: GeometryRequest, grid: GridFound) -> bool:
    """Whether a scan's runs take fewer bits than its boxes, by a sample of it."""
    return asked.form == RUNS or grid.gpu_bits_a_point < BOX_BITS


def geometry_row(asked: GeometryRequest, grid: GridFound) -> Row:
    """The row of the plan: bits a point of runs by those of boxes."""
    share = grid.gpu_bits_a_point / BOX_BITS
    enabled = is_worth_it(asked, grid)
    error = grid.cell / math.sqrt(2)
    reason = "asked to be on" if asked.form == RUNS else f"{share:.2g} {'is below' if enabled else 'reaches'} 1"
    return Row(
        "geometry_runs",
        "positions and normals as runs of cells in a hexagonal close packed grid, in the place of boxes",
        "on" if asked.form == RUNS else AUTO,
        enabled,
        1.0,
        share,
        f"bits a point by those of boxes, at an error of at most {error:.3g}",
        1.0,
        reason,
        "fewer bytes at the error that is asked for",
        {
            "seconds": 4e-6 * grid.n_splats,
            "bytes": round((share - 1) * BOX_BITS / 8 * grid.n_splats),
            "frame_share": 0.0,
        },
        None,
        "stanford_bunny, fountain_p11, volume_iguana_ct",
    )


def request_of_runs(request: str) -> str:
    """What is asked of effects, less those that runs have no place for."""
    return canonical_request([request, *(f"{effect}={OFF}" for effect in NO_PLACE)])


def plan_of_runs(plan: EffectPlan, asked: Mapping[str, str]) -> EffectPlan:
    """The plan of that, which says so in the rows of those effects that nobody `asked` to be off."""
    for effect, reason in NO_PLACE.items():
        plan = plan if asked[effect] == OFF else with_reason(plan, effect, reason)
    return plan


def as_points(made: RunGeometry) -> StageRecord[Points]:
    """Decoded cells in the place of points in chunk order."""
    return replace(made.points, summary=work.summary(made.points.folder, Points))  # type: ignore[arg-type, return-value]


def as_spacings(made: RunGeometry) -> StageRecord[Spacings]:
    """Decoded cells in the place of neighbourhoods."""
    return replace(made.points, summary=work.summary(made.points.folder, Spacings))  # type: ignore[arg-type, return-value]


def runs_report(made: RunGeometry, packed: Path) -> RunsMade:
    """`report.json: runs`, of the packed file that they are in."""
    grid, cells, codes = made.grid.summary, made.cells.summary, made.codes.summary
    return RunsMade(
        cells=cells.n_cells,
        added=cells.n_added,
        twice=codes.n_splats / (cells.n_cells + cells.n_added) - 1,
        points=cells.n_splats,
        cell=grid.cell,
        hit_rate=cells.hit_rate,
        run_length=made.run_length,
        efficiency=codes.mean_length / made.run_length,
        max_error=cells.max_error,
        mean_error=cells.mean_error,
        spacing=grid.spacing,
        mean_normal_error_degrees=codes.mean_normal_error_degrees,
        bits=RunBits(codes.start_bits, codes.steps_bits, codes.normals_bits),
        disk_bits=8 * _stored_bytes(packed) / codes.n_splats,
    )


def _stored_bytes(packed: Path) -> int:
    """What the arrays of runs take in the file."""
    with ZipFile(packed) as archive:
        return sum(
            info.file_size for info in archive.infolist() if info.filename.startswith("run_") and "/c/" in info.filename
        )
