"""The order of the stages: from a scan to a packed file, its previews and its report."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from pipeline.accuracy import psnr_db
from pipeline.effects.block import Sources
from pipeline.effects.depth_margin import LEAST_RADII
from pipeline.effects.exposure import exposed
from pipeline.effects.mip_levels import stored_sizes
from pipeline.effects.plan import EffectPlan, measured_effects, plan_effects
from pipeline.effects.registry import effects
from pipeline.effects.request import ON, parse_request
from pipeline.geometry.frame import directions_of
from pipeline.settings import Settings
from pipeline.stage import Executor, Progress, StageRecord
from pipeline.stages.depth import DepthMaps
from pipeline.stages.effects import MeasureEffects, measures_of
from pipeline.stages.ingest import Ingest
from pipeline.stages.measure import Measure, ingest_fits
from pipeline.stages.neighbours import Neighbourhoods, radius_of
from pipeline.stages.pack import Pack, batches_of, write_packed
from pipeline.stages.partition import Partition
from pipeline.stages.patches import Resample
from pipeline.stages.price import price_for
from pipeline.stages.splats import Splats
from renderer.edges import draw_edges
from renderer.report import build_report, sizes_of, write_report
from services.budget import NO_ATOMS, Trial, check_budget, within_budget
from services.coder import Coded, code_patches, color_step
from services.kept_estimates import against, known_estimate
from services.run import Run
from storage.errors import InvalidScan
from storage.packed import SUFFIX, PackedFile
from storage.schema import BY_NAME, EXTRAS, Camera, Header


@dataclass(frozen=True)
class Prepared:
    """A scan as quantised splats with cameras: what every setting but the radius shares."""

    scan: StageRecord
    partition: StageRecord
    neighbours: StageRecord
    splats: StageRecord
    radius: float
    sources: Sources
    held_out: tuple[int, ...] = ()  # photographs that texture nothing
    effects: EffectPlan = EffectPlan((), {})
    built: tuple[tuple[str, Path], ...] = ()  # by effect, what its encoder made

    @property
    def photos(self) -> Path:
        """The folder of the photographs that splats are textured from, and compared with: like with like."""
        return dict(self.built).get("exposure", self.scan.folder)


def fingerprint(scan: Path) -> str:
    """A hash of the names, sizes and times of a scan's files: changes when they do."""
    files = sorted(p for p in scan.rglob("*") if p.is_file()) if scan.is_dir() else [scan]
    state = hashlib.sha256()
    for path in files:
        stat = path.stat()
        state.update(f"{path.relative_to(scan)}\0{stat.st_size}\0{stat.st_mtime_ns}\n".encode())
    return state.hexdigest()


def prepare(run: Run, scan: Path, radius: float | None, request: str = "", held_out: tuple[int, ...] = (), density: float = 1.0) -> Prepared:
    """The scan as splats, and with the effects that they call for; the photographs `held_out` texture none."""
    return with_effects(run, splats_of(run, scan, radius, held_out, density), request)


def with_effects(run: Run, prepared: Prepared, request: str) -> Prepared:
    """Splats with the effects that they call for."""
    plan, surveys = plan_scan(run, prepared.sources, parse_request(request))
    stages = ((name, effects()[name].build(prepared.sources, plan.outcomes[name], surveys.get(name))) for name in plan.enabled)
    built = {name: run.do(stage).folder for name, stage in stages if stage is not None}
    prepared = replace(prepared, effects=plan)
    if "ellipsoids" in built:
        prepared = _with_ellipsoids(run, prepared, built["ellipsoids"])
        built["ellipsoids"] = prepared.splats.folder
    return replace(prepared, built=tuple(built.items()))


def _with_ellipsoids(run: Run, prepared: Prepared, ellipsoids: Path) -> Prepared:
    """The splats once more, where their ellipsoids lie, so that textures are sampled on what is drawn."""
    s = prepared.sources
    splats = run.do(Splats(s.ingest, s.partition, s.neighbours, s.depth_maps, s.radius, prepared.held_out, ellipsoids))
    return replace(prepared, splats=splats, sources=replace(s, splats=splats.folder))


def splats_of(run: Run, scan: Path, radius: float | None, held_out: tuple[int, ...] = (), density: float = 1.0) -> Prepared:
    """Read the scan, put its points in chunk order, and make splats of them."""
    return splats_from(run, *points_of(run, scan, density), str(scan), radius, held_out)


def points_of(run: Run, scan: Path, density: float = 1.0) -> tuple[StageRecord, StageRecord]:
    """Read the scan, and put its points in chunk order, or that share of them."""
    ingest = run.do(Ingest(str(scan.resolve()), fingerprint(scan)))
    return ingest, run.do(Partition(ingest.folder, density))


def splats_from(run: Run, ingest: StageRecord, partition: StageRecord, scan: str, radius: float | None,
                held_out: tuple[int, ...] = ()) -> Prepared:
    """Make splats of points in chunk order."""
    neighbours = run.do(Neighbourhoods(partition.folder))
    radius = radius_of(neighbours.summary, radius, scan)
    depth = None
    if ingest.summary["cameras"] and not ingest.summary["has_visibility"]:
        depth = run.do(DepthMaps(ingest.folder, partition.folder, radius)).folder
    splats = run.do(Splats(ingest.folder, partition.folder, neighbours.folder, depth, radius, held_out))
    sources = Sources(ingest.folder, partition.folder, neighbours.folder, depth, splats.folder, radius,
                      *directions_of(ingest.summary["cameras"]), held_out)
    return Prepared(ingest, partition, neighbours, splats, radius, sources, held_out)


def plan_scan(run: Run, sources: Sources, request: dict[str, str]) -> tuple[EffectPlan, dict[str, Path]]:
    """Measure the scan for every effect that the request leaves open, and plan; and what the surveys of effects made."""
    names = measured_effects(request)
    if not names:
        return plan_effects({}, request, sources.n_splats), {}
    stages = ((name, effects()[name].survey(sources)) for name in names)
    surveys = tuple((name, run.do(stage).folder) for name, stage in stages if stage is not None)
    found = run.do(MeasureEffects(sources, names, surveys)).summary
    return plan_effects(measures_of(found), request, sources.n_splats), dict(surveys)


def is_textured(prepared: Prepared) -> bool:
    """Whether any splat has a photograph."""
    return prepared.splats.summary["n_without_camera"] < prepared.splats.summary["n_splats"]


def code(run: Run, prepared: Prepared, settings: Settings) -> Coded:
    """Resample patches, and code them."""
    return code_prepared(run, prepared, resample(run, prepared), settings)


def code_prepared(run: Run, prepared: Prepared, patches: StageRecord, settings: Settings, n_splats: int | None = None) -> Coded:
    """Code the patches of splats, which are all or a sample of `n_splats`, for the target or within the budget."""
    n_sample, most_texels = prepared.splats.summary["n_splats"], texels_of_levels(prepared, settings)[0]
    if settings.budget_bytes is None:
        return code_patches(run, patches, settings, n_splats, most_texels)
    share, first = n_sample / (n_splats or n_sample), []

    def attempt(price: float) -> Trial:
        def priced(ladder: dict, training: dict) -> float:
            first.append(price_for(ladder, training))
            return price

        n_before = len(run.records)
        coded = code_patches(run, patches, settings, n_splats, most_texels, priced)
        known = {record.folder for record in run.records[:n_before]}
        run.records[n_before:] = [record for record in run.records[n_before:] if record.folder not in known]
        return Trial(price, _gpu_bytes(pack(run, prepared, coded, settings, "trial", None), share), coded)

    bare = attempt(NO_ATOMS)
    if not first:  # nothing calls for atoms, or none are allowed
        check_budget(settings.budget_bytes, n_sample, bare.n_bytes)
        return bare.result
    return within_budget(settings.budget_bytes, n_sample, first[0], lambda price: bare if price == NO_ATOMS else attempt(price)).result


def _gpu_bytes(packed: StageRecord, share: float = 1.0) -> float:
    """Of a scan's splats, or of a sample's, to which a `share` of the dictionary is counted."""
    counted = {"dictionary": share, "provenance": 0.0}
    return sum(n * counted.get(BY_NAME[name].part, 1.0) for name, n in packed.summary["bytes"].items())


def texels_of_levels(prepared: Prepared, settings: Settings) -> tuple[int, int]:
    """Texels to a side of the finest and of the coarsest mip level that atoms need."""
    plan = prepared.effects
    asked_for = parse_request(settings.effects)["mip_levels"] == ON
    return stored_sizes(plan.measured.get("mip_levels"), asked_for, settings.view_distance, "level_blending" in plan.enabled)


def resample(run: Run, prepared: Prepared) -> StageRecord:
    """Sample the photographs into patches."""
    scan = prepared.scan
    return run.do(Resample(prepared.photos, prepared.partition.folder, prepared.splats.folder, prepared.radius,
                           *directions_of(scan.summary["cameras"]), "antialiasing" in prepared.effects.enabled))


def _stored_index_bits(coded: Coded | None, settings: Settings) -> int:
    """No more than the indices take; the paper's coder has those of its name."""
    if settings.coder == "paper" and settings.dictionary_bits != "auto":
        return settings.dictionary_bits
    n_indices = coded.n_dictionary * coded.quantized.summary["n_turns"] if coded and coded.quantized else 1
    return max(1, (n_indices - 1).bit_length())


def _stored_form(coded: Coded | None, coarsest: int) -> dict:
    found = coded.quantized.summary if coded and coded.quantized else {}
    form = {name: found[name] for name in ("atom_size", "n_turns") if name in found}
    return form | {"coarsest_size": min(coarsest, form["atom_size"])} if form else {}


def pack(run: Run, prepared: Prepared, coded: Coded | None, settings: Settings, name: str, path: Path | None) -> StageRecord:
    """Write the packed file to `path`; None leaves it a folder of the work folder's."""
    scan = prepared.scan.summary
    flag_of = {extra.stream: extra.flag for extra in EXTRAS}  # an effect is named as its stream
    extras = tuple((flag_of[name], folder) for name, folder in prepared.built if name in flag_of)
    n_splats = prepared.splats.summary["n_splats"]
    batches = batches_of(n_splats, coded.codes.folder if coded else None, extras)
    margin = prepared.effects.outcomes.get("depth_margin", {"margin_radii": LEAST_RADII})["margin_radii"]
    up, ahead = directions_of(scan["cameras"])
    header = Header(
        n_splats=n_splats, radius=prepared.radius, unit=scan["unit"],
        origin=tuple(prepared.partition.summary["origin"]), up=up, ahead=ahead,
        depth_margin=margin * prepared.radius, n_dictionary=coded.n_dictionary if coded else 0,
        dictionary_bits=_stored_index_bits(coded, settings), weight_bits=settings.weight_bits, **_stored_form(coded, texels_of_levels(prepared, settings)[1]),
        batches=batches, effects=prepared.effects.outcomes, n_ranks=max([1, *(batch.n_atoms for batch in batches)]),
        color_step=color_step(settings) if coded else 0,
        cameras=tuple(Camera.from_json(c) for c in scan["cameras"]),
        scan={"name": name, "format": scan["format"], "n_points": scan["n_read"]}, settings=asdict(settings),
    )
    record = run.do(Pack(header, prepared.splats.folder, coded.colors.folder if coded else None,
                         coded.codes.folder if coded else None, coded.quantized.folder if coded and coded.quantized else None,
                         extras))
    if path is not None:
        write_packed(record.folder, path)
    return record


def compress(scan: Path, out: Path, settings: Settings, executor: Executor, progress: Progress, *, render: bool = True,
             work: Path | None = None) -> dict:
    """Compress a scan into `out`: NAME.splatpress, report.json, report.html and previews/. Returns the report.

    `out` appears with all of it, or not at all. With `work` the outputs of the stages stay there and are used again;
    else they are thrown away.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        run = Run(work or made / "work", executor, progress)
        report = make(run, scan, settings, made, render)
        if work is None:
            shutil.rmtree(made / "work")
        put_in_place(made, out)
        return report
    finally:
        shutil.rmtree(made, ignore_errors=True)


def make(run: Run, scan: Path, settings: Settings, out: Path, render: bool = True) -> dict:
    """All of a job, into the folder `out`, which is there. Returns the report."""
    name = scan.resolve().name.removesuffix(".zip") if scan.is_dir() else scan.stem
    path = out / (name + SUFFIX)
    prepared = prepare(run, scan, settings.radius, settings.effects, density=settings.density)
    coded = code(run, prepared, settings) if is_textured(prepared) else None
    packed = pack(run, prepared, coded, settings, name, path)
    if settings.budget_bytes is not None:
        check_budget(settings.budget_bytes, prepared.splats.summary["n_splats"], _gpu_bytes(packed))
    return finish(run, path, prepared, coded, settings, out, render)


def finish(run: Run, path: Path, prepared: Prepared, coded: Coded | None, settings: Settings, out: Path, render: bool) -> dict:
    """Previews and report of a packed file just made."""
    record = {
        "scan": _scan_record(prepared), "quality": _quality(prepared, coded),
        "learning": coded.learning if coded else [], "numerics": _numerics(prepared, coded), "settings": asdict(settings),
        "effects": prepared.effects.to_json(),
        "estimate": _estimate(run, path, coded, settings),
    }
    return write_outputs(run, path, prepared.photos, record, out, render)


def _estimate(run: Run, path: Path, coded: Coded | None, settings: Settings) -> dict | None:
    """What was estimated for this job, beside what happened up to its packed file, in stages run now or before."""
    estimate = known_estimate(run.work, settings)
    if estimate is None:
        return None
    with PackedFile(path, verify=False) as packed:
        n_bytes = sizes_of(packed.load(), 0)["gpu_bytes"]
    return against(estimate, {
        "seconds": sum(r.made_seconds for r in run.records), "peak_memory_bytes": max(r.peak_rss_bytes for r in run.records),
        "gpu_bytes": n_bytes, "texture_psnr_db": coded.codes.summary["texture_psnr_db"] if coded else None})


def write_outputs(run: Run, path: Path, photos: Path, record: dict, out: Path, render: bool) -> dict:
    """previews/, edges/, report.json and report.html beside each other in `out`. Returns the report."""
    from renderer.report_page import write_page  # Bokeh takes 2 s to import, which an estimate does without

    with PackedFile(path) as packed:
        scene = packed.load()
    views = _views(run, path, photos, out) if render else []
    edges = run.paint(draw_edges, path, photos, out) if render and "cliplines" in scene.arrays and scene.header.cameras else []
    record = record | {"edges": edges, "stages": [stage_row(r) for r in merged(run.records)]}
    report = build_report(scene, path.stat().st_size, record, views)
    write_report(out, report)
    write_page(out, report, scene)
    return report


def _views(run: Run, path: Path, photos: Path, out: Path) -> list[dict]:
    begun = time.perf_counter()
    done = 0

    def on_view(n_done: int, n_views: int) -> None:
        nonlocal done
        if done == 0:
            run.progress.begin("render", n_views)
        run.progress.advance("render", n_done - done, 0)
        done = n_done

    run.progress.begin("render", 1)
    views = run.draw(path, photos, out, on_view)
    record = StageRecord("render", out, {}, time.perf_counter() - begun, 0, len(views), 0, False)
    run.records.append(record)
    run.progress.end(record)
    return views


def _scan_record(prepared: Prepared) -> dict:
    scan = prepared.scan.summary
    warnings = list(scan["warnings"])
    n_bad = prepared.neighbours.summary["n_degenerate"]
    if n_bad:
        warnings.append(f"{n_bad} of {scan['n_points']} splats have no normal of the scan's, and none that their neighbourhood defines")
    if not (scan["has_colors"] or scan["cameras"]):
        warnings.append("the scan has neither colours nor intensity nor photographs; its splats are grey, shaded by their normals")
    n_blind = prepared.splats.summary["n_without_camera"]
    if scan["cameras"] and n_blind:
        warnings.append(f"{n_blind} of {scan['n_points']} splats are seen by no camera and have the scan's colour")
    return {"unit": scan["unit"], "n_points": scan["n_read"], "n_cameras": len(scan["cameras"]), "warnings": warnings}


def _numerics(prepared: Prepared, coded: Coded | None) -> dict:
    """The hard cases that were met, counted."""
    scan = prepared.scan.summary
    blind = prepared.splats.summary["n_without_camera"] if scan["cameras"] else 0
    return {"dropped_points": scan["n_dropped"], "degenerate_normals": prepared.neighbours.summary["n_degenerate"],
            "flagged_projections": coded.patches.summary["n_flagged"] if coded else blind,
            "replaced_atoms": sum(row["replaced_atoms"] for row in coded.learning) if coded else 0,
            "safeguard_steps": coded.safeguard_steps if coded else 0}


def _quality(prepared: Prepared, coded: Coded | None) -> dict:
    splats = prepared.splats.summary
    geometry = {"mean_position_error": splats["mean_position_error"],
                "mean_position_error_in_radii": splats["mean_position_error"] / prepared.radius,
                "mean_normal_error_degrees": splats["mean_normal_error_degrees"]}
    texture = dict.fromkeys(("texture_psnr_db", "visible_psnr_db", "resampling_psnr_db"))
    if coded:
        texture = {k: (coded.codes.summary | coded.patches.summary)[k] for k in texture}
    return texture | {"geometry": geometry}


def merged(records: list[StageRecord]) -> list[StageRecord]:
    """One row a stage: the iterations of k-SVD are added up."""
    rows: dict[str, StageRecord] = {}
    for r in records:
        if (row := rows.get(r.name)) is not None:
            r = replace(r, seconds=row.seconds + r.seconds, peak_rss_bytes=max(row.peak_rss_bytes, r.peak_rss_bytes),
                        n_tasks=row.n_tasks + r.n_tasks, n_splats=row.n_splats + r.n_splats)
        rows[r.name] = r
    return list(rows.values())


def stage_row(record: StageRecord) -> dict:
    """A stage as the report lists it."""
    rate = record.n_splats / record.seconds if record.n_splats and record.seconds > 0 and not record.reused else None
    return {"name": record.name, "seconds": record.seconds, "peak_rss_bytes": record.peak_rss_bytes or None,
            "splats_per_second": rate, "tasks": record.n_tasks, "reused": record.reused}


def report(packed: Path, scan: Path, out: Path, executor: Executor, progress: Progress, *, render: bool = True) -> dict:
    """Measure a packed file against the scan's photographs, and write previews and report into `out`."""
    out.mkdir(parents=True, exist_ok=True)
    with PackedFile(packed) as opened, tempfile.TemporaryDirectory(prefix=".work.", dir=out) as work:
        run = Run(Path(work), executor, progress)
        header = opened.header
        quality, numerics = {}, {}
        ingest = run.do(Ingest(str(scan.resolve()), fingerprint(scan)))
        if not ingest_fits(ingest.folder, [c.name for c in header.cameras]):
            raise InvalidScan(str(scan), f"photographs {[c['name'] for c in ingest.summary['cameras']][:3]}...",
                              f"those that {packed.name} was made from, {[c.name for c in header.cameras][:3]}...")
        photos = ingest.folder
        if "exposure" in header.effects and header.cameras:
            photos = run.do(exposed(ingest.folder, header.effects["exposure"])).folder
        if header.cameras:
            measured = run.do(Measure(photos, packed.resolve(), fingerprint(packed))).summary
            numerics = {"flagged_projections": measured["n_flagged"]}
            quality = {k: measured[k] for k in ("texture_psnr_db", "visible_psnr_db", "resampling_psnr_db")}
        record = {"scan": {"n_cameras": len(header.cameras), "warnings": ingest.summary["warnings"]}, "quality": quality,
                  "numerics": numerics | {"dropped_points": ingest.summary["n_dropped"]}}
        return write_outputs(run, packed, photos, record, out, render)


def put_in_place(made: Path, out: Path) -> None:
    """Let `out` be what was made; an older `out` goes only when the new one is whole."""
    made.chmod(0o755)
    old = made.with_name(made.name + ".old")
    if out.exists():
        os.replace(out, old)
    os.replace(made, out)
    shutil.rmtree(old, ignore_errors=True)
