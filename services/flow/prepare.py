"""From a scan to splats with the effects that they call for: what every setting but the radius shares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.effects.block import Sources
from pipeline.effects.levels import possible_levels
from pipeline.effects.plan.plan import EffectPlan, Row
from pipeline.effects.plan.registry import effects
from pipeline.effects.plan.request import AUTO, OFF, canonical_request, parse_request
from pipeline.effects.station_maps import has_maps
from pipeline.execution.stage import StageRecord
from pipeline.geometry.frame import directions_of
from pipeline.geometry.sizes import BITS
from pipeline.readers.attributes.options import ReadOptions
from pipeline.stages.maps.map_cliplines import MapCliplines
from pipeline.stages.maps.resample_maps import MappedSplats
from pipeline.stages.points.depth_maps import DepthMaps
from pipeline.stages.points.levels import with_levels
from pipeline.stages.points.neighbours import Neighbourhoods, radius_of, signs_are_open
from pipeline.stages.points.sizes import Sizes
from pipeline.stages.points.splats import Splats
from pipeline.summaries import Points, ScanRead, Spacings, SplatsMade
from pipeline.volumes.request import SurfaceRequest
from services.flow.maps import StationMaps, draw_maps, maps_for, with_edits
from services.flow.points.called_for import calls_for_levels, calls_for_sizes, plan_scan
from services.flow.points.quadrics import quadric_error, quadrics_row
from services.flow.points.read import in_chunk_order, points_of
from services.flow.points.runs import (
    GeometryRequest,
    RunGeometry,
    as_points,
    as_spacings,
    geometry_row,
    grid_for,
    plan_of_runs,
    request_of_runs,
    runs_of_splats,
)
from services.flow.run import Run
from storage.errors import InvalidScan
from storage.packed.schema import RUNS


@dataclass(frozen=True)
class Prepared:
    """A scan as quantised splats with cameras: what every setting but the radius shares."""

    scan: StageRecord[ScanRead]
    partition: StageRecord[Points]
    neighbours: StageRecord[Spacings]
    splats: StageRecord[SplatsMade]
    radius: float
    sources: Sources
    held_out: tuple[int, ...] = ()  # photographs that texture nothing
    effects: EffectPlan = EffectPlan((), {})
    built: tuple[tuple[str, Path], ...] = ()  # by effect, what its encoder made
    maps: StationMaps | None = None  # of a laser scan's stations, where they texture its splats
    runs: RunGeometry | None = None  # where its geometry is runs
    geometry: tuple[Row, ...] = ()  # of the plan: where boxes, runs and quadrics were weighed
    quadric_error: tuple[float, float] | None = None  # where its geometry is quadrics: mean ones, radii and degrees

    @property
    def photos(self) -> Path:
        """The folder of the photographs that splats are textured from, and compared with: like with like."""
        return dict(self.built).get("exposure", self.scan.folder)

    def on_maps(self, maps: Path) -> MappedSplats:
        """Its splats, with the maps of stations in that folder."""
        directions = directions_of(self.scan.summary.cameras)
        return MappedSplats(maps, self.partition.folder, self.splats.folder, self.radius, *directions)


def prepare(
    run: Run,
    scan: Path,
    radius: float | None,
    request: str = "",
    held_out: tuple[int, ...] = (),
    density: float = 1.0,
    surface: SurfaceRequest = SurfaceRequest(),
    reading: ReadOptions = ReadOptions(),
    edited_maps: Path | None = None,
    levels: int | None = None,
    geometry: GeometryRequest = GeometryRequest(),
) -> Prepared:
    """The scan as splats, and with the effects that they call for; the photographs `held_out` texture none,
    `surface` is what is asked of a volume, `edited_maps` a folder of edited pictures of stations' maps, and `levels` how many
    coarser ones there are at most; None leaves that to the scan."""
    splats = splats_of(run, scan, radius, request, held_out, density, surface, reading, levels, geometry)
    return with_maps(run, with_effects(run, splats, request), edited_maps)


def with_maps(run: Run, prepared: Prepared, edited: Path | None = None) -> Prepared:
    """Splats with the maps of their stations, where the plan has them on; `edited` pictures in place of those drawn.

    Raises: InvalidScan for edited pictures of a scan that no maps are drawn of.
    """
    if "station_maps" not in prepared.effects.enabled or not has_maps(prepared.scan.summary):
        if edited is not None:
            raise InvalidScan(
                str(edited),
                "maps for a scan that none texture",
                "maps of a laser scan with stations and colours",
                "`splatpress effects` says whether they are on",
            )
        return prepared
    drawn = draw_maps(run, prepared.scan, *_all_points(run, prepared))
    splats = prepared.on_maps(with_edits(run, drawn.folder, edited))
    maps = maps_for(run, splats)
    built = dict(prepared.built)
    if "cliplines" in built:
        built["cliplines"] = run.do(MapCliplines(splats)).folder
    return replace(prepared, maps=maps, built=tuple(built.items()))


def _all_points(run: Run, prepared: Prepared) -> tuple[StageRecord[Points], StageRecord[Spacings]]:
    """All points of the scan in chunk order, and their neighbours, whatever share of them became splats."""
    if prepared.partition.summary.n_splats == prepared.scan.summary.n_points:
        return prepared.partition, prepared.neighbours
    partition = in_chunk_order(run, prepared.scan, 1.0)
    return partition, run.do(Neighbourhoods(partition.folder))


def with_effects(run: Run, prepared: Prepared, request: str) -> Prepared:
    """Splats with the effects that they call for."""
    of_runs = prepared.runs is not None
    plan, surveys = plan_scan(run, prepared.sources, parse_request(request_of_runs(request) if of_runs else request))
    plan = plan_of_runs(plan, parse_request(request)) if of_runs else plan
    stages = (
        (name, effects()[name].build(prepared.sources, plan.outcomes[name], surveys.get(name))) for name in plan.enabled
    )
    built = {name: run.do(stage).folder for name, stage in stages if stage is not None}
    prepared = replace(prepared, effects=replace(plan, rows=(*prepared.geometry, *plan.rows)))
    if "ellipsoids" in built:
        prepared = _with_ellipsoids(run, prepared, built["ellipsoids"])
        built["ellipsoids"] = prepared.splats.folder
    return replace(prepared, built=tuple(built.items()))


def _with_ellipsoids(run: Run, prepared: Prepared, ellipsoids: Path) -> Prepared:
    """The splats once more, where their ellipsoids lie, so that textures are sampled on what is drawn."""
    s, error = prepared.sources, prepared.quadric_error
    places = s.ingest, s.partition, s.neighbours, s.depth_maps
    made = Splats(*places, s.radius, prepared.held_out, ellipsoids, s.used_sizes, quadric_error=error)
    splats = run.do(made)
    return replace(prepared, splats=splats, sources=replace(s, splats=splats.folder))


def splats_of(
    run: Run,
    scan: Path,
    radius: float | None,
    request: str = "",
    held_out: tuple[int, ...] = (),
    density: float = 1.0,
    surface: SurfaceRequest = SurfaceRequest(),
    reading: ReadOptions = ReadOptions(),
    levels: int | None = None,
    geometry: GeometryRequest = GeometryRequest(),
) -> Prepared:
    """Read the scan, put its points in chunk order, and make splats of them, and of coarser levels of them; or of cells of runs."""
    points = points_of(run, scan, density, surface, reading, geometry.form == RUNS)
    return splats_from(run, *points, str(scan), radius, request, held_out, levels, geometry)


def splats_from(
    run: Run,
    ingest: StageRecord[ScanRead],
    partition: StageRecord[Points],
    scan: str,
    radius: float | None,
    request: str = "",
    held_out: tuple[int, ...] = (),
    levels: int | None = None,
    geometry: GeometryRequest = GeometryRequest(),
) -> Prepared:
    """Make splats of points in chunk order: of `radius`, or each of the size that the scan calls for; and of its levels; or of cells of
    runs, which have none."""
    settle = signs_are_open(ingest.summary, partition.folder)
    neighbours = run.do(Neighbourhoods(partition.folder, settle))
    sources = run, ingest, partition, neighbours, scan, radius

    def splats_with(error: tuple[float, float] | None) -> Prepared:
        return _sized_splats(*sources, request, held_out, levels, quadric_error=error)

    if geometry.form != RUNS and (geometry.form != AUTO or geometry.cell is None):
        return _over_quadrics_or_in_boxes(geometry, splats_with)
    plain = canonical_request([request, "levels=off"])
    boxes = _sized_splats(*sources, plain, held_out, 0)
    grid = grid_for(run, geometry, ingest.summary, partition.folder, boxes.splats.folder)
    row = geometry_row(geometry, grid.summary)
    if not row.enabled:
        splats = _over_quadrics_or_in_boxes(geometry, splats_with)
        return replace(splats, geometry=(row, *splats.geometry))
    folders = partition.folder, neighbours.folder, boxes.splats.folder
    runs = runs_of_splats(run, geometry, grid, *folders, of_volume=ingest.summary.grid is not None)
    points, near = as_points(runs), as_spacings(runs)
    made = _sized_splats(run, ingest, points, near, scan, radius, plain, held_out, 0, of_runs=True)
    return replace(made, runs=runs, geometry=(row,))


def _over_quadrics_or_in_boxes(
    asked: GeometryRequest, splats_with: Callable[[tuple[float, float] | None], Prepared]
) -> Prepared:
    """Whichever is asked for, or fewer bits at the asked error."""
    made = splats_with(error := quadric_error(asked))
    if error is None:
        return made
    row = quadrics_row(asked, made.splats.summary, made.sources.used_sizes is not None)
    return replace(made if row.enabled else splats_with(None), geometry=(row,))


def _sized_splats(
    run: Run,
    ingest: StageRecord[ScanRead],
    partition: StageRecord[Points],
    neighbours: StageRecord[Spacings],
    scan: str,
    radius: float | None,
    request: str,
    held_out: tuple[int, ...],
    levels: int | None,
    of_runs: bool = False,
    quadric_error: tuple[float, float] | None = None,
) -> Prepared:
    asked_radius, radius = radius, radius_of(neighbours.summary, radius, scan)
    needed, sizes, bits = None, None, BITS if quadric_error is None else None
    if asked_radius is None and parse_request(request)["sizes"] != OFF:
        needed = run.do(Sizes(partition.folder, neighbours.folder, radius, bits=bits))
        sizes = needed.folder if calls_for_sizes(needed.summary, request) else None
    depth = None
    if ingest.summary.cameras and not ingest.summary.has_visibility:
        depth = run.do(DepthMaps(ingest.folder, partition.folder, radius, sizes)).folder
    counts = possible_levels(partition.summary.n_splats, levels)
    near = neighbours.folder
    if len(counts) > 1 and (levels or calls_for_levels(counts, request)):
        partition, near, sizes = with_levels(run.do, partition, near, needed, sizes, radius, len(counts) - 1, bits)
    points = ingest.folder, partition.folder, near, depth
    splats = run.do(Splats(*points, radius, held_out, None, sizes, of_runs, quadric_error))
    sources = Sources(
        ingest.folder,
        partition.folder,
        near,
        depth,
        splats.folder,
        radius,
        *directions_of(ingest.summary.cameras),
        held_out,
        sizes or (needed.folder if needed else None),
    )
    made = Prepared(ingest, partition, neighbours, splats, radius, sources, held_out)
    return replace(made, quadric_error=quadric_error)


def has_photographs(prepared: Prepared) -> bool:
    """Whether any splat has a photograph."""
    return prepared.splats.summary.n_without_camera < prepared.splats.summary.n_splats


def is_textured(prepared: Prepared) -> bool:
    """Whether splats have photographs, or station maps, to be textured from."""
    return has_photographs(prepared) or prepared.maps is not None


def wants_texture(prepared: Prepared, texture: str) -> bool:
    """Whether splats are to be textured, as the knob `texture` has it.

    Raises: InvalidScan where atoms or maps are asked for, and there is nothing that they could show.
    """
    if texture == "map" and prepared.maps is None:
        raise InvalidScan(
            "texture",
            "map, of a scan without stations and colours of its own, or with photographs",
            "auto, color, atoms",
            "--station x,y,z says where the scanner of a merged scan stood",
        )
    if texture == "atoms" and not is_textured(prepared):
        raise InvalidScan(
            "texture",
            "atoms, of a scan with neither photographs that see its points nor stations with colours",
            "auto, color",
            "--station x,y,z says where the scanner of a merged scan stood",
        )
    return texture != "color" and is_textured(prepared)
