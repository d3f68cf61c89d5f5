"""What lies beside a packed file: previews, edges, report.json and report.html."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from pipeline.catalogue import RENDER
from pipeline.execution.stage import StageRecord
from renderer.evaluate.edges import draw_edges
from renderer.evaluate.stations.pictures import draw_stations
from renderer.report.document import RunRecord, StageCost, ViewMeasured
from renderer.report.report import as_json, build_report, write_report
from services.flow.maps import StationMaps
from services.flow.run import Run
from storage.packed.packed import PackedFile, PackedScene
from storage.packed.totals import Totals

GROUPS = 512  # 4 million splats, which take 3 s


def write_outputs(
    run: Run, path: Path, photos: Path, record: RunRecord, out: Path, render: bool, maps: StationMaps | None = None
) -> dict:
    """previews/, edges/, maps/, report.json and report.html beside each other in `out`. Returns the report, as
    report.json has it."""
    from renderer.report.report_page import write_page  # Bokeh takes 2 s to import, which an estimate does without

    with PackedFile(path) as packed:
        scene, totals = _looked_at(packed)
    views = _views(run, path, photos, out) if render else []
    edges = (
        run.paint(draw_edges, path, photos, out)
        if render and "cliplines" in scene.arrays and scene.header.cameras
        else []
    )
    stations = run.paint(draw_stations, path, maps.folder, maps.log_gain, out) if render and maps else []
    known = msgspec.structs.replace(
        record,
        edges=tuple(edges),
        stations=tuple(stations),
        stages=tuple(stage_row(r) for r in merged(run.records)),
    )
    report = as_json(build_report(scene, path.stat().st_size, known, views, totals))
    write_report(out, report)
    write_page(out, report, scene)
    return report


def _looked_at(packed: PackedFile) -> tuple[PackedScene, Totals | None]:
    """All of a file; of a large one GROUPS spread evenly, whose atoms stand for all in the picture of the dictionary,
    and the totals of the whole. A process alone takes 0.7 us a splat to read it."""
    n = packed.header.n_groups
    if packed.header.runs or n <= GROUPS:
        return packed.load(), None
    some = ((np.arange(GROUPS) + 0.5) * n / GROUPS).astype(int).tolist()
    return packed.joined({i: packed.rows_of_group(i) for i in some}, packed.of_all()), packed.totals()


def _views(run: Run, path: Path, photos: Path, out: Path) -> list[ViewMeasured]:
    begun = time.perf_counter()
    done = 0

    def on_view(n_done: int, n_views: int) -> None:
        nonlocal done
        if done == 0:
            run.progress.begin(RENDER, n_views)
        run.progress.advance(RENDER, n_done - done, 0)
        done = n_done

    run.progress.begin(RENDER, 1)
    views = run.draw(path, photos, out, on_view)
    record: StageRecord = StageRecord(RENDER, out, None, time.perf_counter() - begun, 0, len(views), 0, False)
    run.records.append(record)
    run.progress.end(record)
    return views


def merged(records: list[StageRecord]) -> list[StageRecord]:
    """One row a stage: the iterations of k-SVD are added up."""
    rows: dict[str, StageRecord] = {}
    for r in records:
        if (row := rows.get(r.name)) is not None:
            r = replace(
                r,
                seconds=row.seconds + r.seconds,
                peak_rss_bytes=max(row.peak_rss_bytes, r.peak_rss_bytes),
                n_tasks=row.n_tasks + r.n_tasks,
                n_splats=row.n_splats + r.n_splats,
            )
        rows[r.name] = r
    return list(rows.values())


def stage_row(record: StageRecord) -> StageCost:
    """A stage as the report lists it."""
    rate = record.n_splats / record.seconds if record.n_splats and record.seconds > 0 and not record.reused else None
    return StageCost(
        name=record.name,
        seconds=record.seconds,
        peak_rss_bytes=record.peak_rss_bytes or None,
        splats_per_second=rate,
        tasks=record.n_tasks,
        reused=record.reused,
    )
