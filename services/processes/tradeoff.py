"""What accuracy costs on one scan: its presets, and each knob alone around one of them, all measured."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from msgspec import structs

from pipeline.catalogue import PICTURES
from pipeline.execution.stage import Executor, Progress, StageRecord
from pipeline.numerics.accuracy import BEST_DB
from pipeline.planning.knobs import BY_NAME, KNOBS
from pipeline.planning.settings import PRESETS, Settings
from renderer.evaluate.close_ups import Variant, draw_close_ups, time_passes
from renderer.evaluate.compare import not_measured
from renderer.evaluate.picture_psnr import picture_psnrs
from renderer.report.evaluation_document import CloseUp
from renderer.report.report import sizes_of
from renderer.report.tradeoff_document import LadderPoint, LadderScan, LadderStep, TradeoffDocument
from services.flow.asked import prepare_asked
from services.flow.code import code_prepared, resample
from services.flow.pack import pack
from services.flow.prepare import has_photographs
from services.flow.run import Run
from services.processes.kinds import BUDGET_S
from storage.errors import InvalidScan
from storage.packed.packed import SUFFIX, PackedFile
from storage.packed.schema import RUNS
from storage.whole import placed_whole

# Knobs that change a scan without photographs.
OF_POINTS = {"density", "levels", "radius", "effects", "geometry", "cell"}
DENSITIES = (1.0, 0.5, 0.25, 0.1)
SPOTS = slice(1, None, 2)  # of `choose_spots`: a good one, a middling one, the worst


@dataclass(frozen=True)
class Step:
    """One point of the ladder: the settings, and how they differ from the chosen preset: a preset, or one knob."""

    key: str
    settings: Settings
    preset: str | None = None
    knob: str | None = None

    @property
    def command(self) -> str:
        """The arguments of compress that ask for it."""
        changed = [k for k in KNOBS if getattr(self.settings, k.name) != getattr(PRESETS[self.settings.preset], k.name)]
        return " ".join(
            [
                f"--preset {self.settings.preset}",
                *(f"--{k.name.replace('_', '-')} {getattr(self.settings, k.name)}" for k in changed),
            ]
        )


def ladder(settings: Settings, knobs: Mapping[str, Sequence]) -> list[Step]:
    """The presets, the chosen settings first, then the values of each knob, all knobs in turns: where a budget ends the
    ladder early, every knob has been tried. Settings that come twice are measured once. What no preset decides, as the
    density or how the scan is read, is as chosen everywhere."""
    chosen = Step("chosen", settings, settings.preset if settings == PRESETS[settings.preset] else None)
    kept = {k.name: getattr(settings, k.name) for k in KNOBS if _alike_in_presets(k.name)}
    steps = [chosen] + [Step(name, replace(preset, **kept), name) for name, preset in PRESETS.items()]
    longest = max(map(len, knobs.values()), default=0)
    for turn in range(longest):
        for name, values in knobs.items():
            if turn < len(values):
                changed = replace(settings, **{name: values[turn]})
                steps.append(Step(f"{name}={values[turn]}", changed, None, name))
    unique: dict[tuple, Step] = {}
    for step in steps:
        unique.setdefault(asdict_key(step.settings), step)
    return list(unique.values())


def _alike_in_presets(knob: str) -> bool:
    """Whether no preset decides about it. A budget of bytes stands in the place of the target, which they do decide."""
    return knob != "budget_bytes" and len({getattr(preset, knob) for preset in PRESETS.values()}) == 1


def asdict_key(settings: Settings) -> tuple:
    """Settings as they decide a file: the preset's name does not."""
    return tuple((k, v) for k, v in asdict(settings).items() if k != "preset")


def default_knobs() -> dict[str, tuple]:
    """Those that have a ladder; the target first, as what the next decibels cost is what is asked first."""
    known = {knob.name: knob.ladder for knob in KNOBS if knob.ladder}
    return {"target_psnr_db": known.pop("target_psnr_db")} | known


def parsed_knobs(texts: Sequence[str]) -> dict[str, tuple]:
    """Of texts as `iterations=1,3,6`. Raises ValueError saying what is allowed."""
    found = {}
    for text in texts:
        name, equals, values = text.partition("=")
        if not equals or name not in BY_NAME:
            raise ValueError(f"knob {text!r} is not NAME=VALUE,... with one of the names {', '.join(BY_NAME)}")
        found[name] = tuple(BY_NAME[name].parsed(value) for value in values.split(","))
    return found


def tradeoff(
    scan: Path,
    out: Path,
    settings: Settings,
    executor: Executor,
    progress: Progress,
    *,
    knobs: Mapping[str, Sequence] | None = None,
    budget_s: float = BUDGET_S,
    render: bool = True,
    work: Path | None = None,
) -> TradeoffDocument:
    """Measure the ladder within a budget; writes tradeoff.json, tradeoff.html and close-ups into `out`. Returns the
    document.

    `out` appears with all of it, or not at all. Stages that a change does not touch run once.
    """
    with placed_whole(out) as made:
        run = Run(work or made / "work", executor, progress)
        document = measure_ladder(run, scan, made, settings, knobs, budget_s, render)
        shutil.rmtree(made / "work", ignore_errors=True)
    return document


def measure_ladder(
    run: Run,
    scan: Path,
    out: Path,
    settings: Settings,
    knobs: Mapping[str, Sequence] | None = None,
    budget_s: float = BUDGET_S,
    render: bool = True,
    name: str | None = None,
) -> TradeoffDocument:
    """All of it, into the folder `out`, which is there; the scan is called `name`, else as its file.

    Of a scan without photographs the knobs OF_POINTS are, beside all of its points, which pictures are then compared with.

    Raises: InvalidScan for a scan without photographs, where nothing is to be drawn.
    """
    begun = run.clock()
    folder = out / "packed"
    folder.mkdir(exist_ok=True)
    points: list[LadderPoint] = []
    packed: list[Path] = []
    skipped: list[LadderStep] = []
    made: dict[tuple, str] = {}
    last, photos = 0.0, None
    tried: Mapping[str, Sequence] = default_knobs() if knobs is None else knobs
    steps = ladder(settings, tried)
    for i, step in enumerate(steps):
        if points and photos is None and step.knob not in OF_POINTS:
            continue
        if points and run.clock() - begun + last > budget_s:
            skipped.append(LadderStep(step.key, step.command))
            continue
        run.round(i, len(steps) + 1)  # the pictures are one more
        path = folder / f"{step.key.replace('/', '-')}{SUFFIX}"
        point, photos, last = _point(run, scan, step, path, render, made)
        points.append(point)
        packed.append(path)
        if i == 0 and photos is None:  # the loop goes on with these
            known = {asdict_key(step.settings) for step in steps}
            more = ladder(settings, {"density": DENSITIES if knobs is None else DENSITIES[:1]})
            steps[1:1] = [step for step in more if step.knob and asdict_key(step.settings) not in known]
    run.round(len(steps), len(steps) + 1)
    points, close_ups = _pictures(run, points, packed, photos, out) if render else (points, ())
    from renderer.report.tradeoff_page import summarised, write_tradeoff  # bokeh takes half a second to import

    found = summarised(points)
    document = TradeoffDocument(
        scan=LadderScan(name or scan.resolve().name, points[0].n_cameras),
        splats=points[0].splats,
        preset=settings.preset,
        budget_s=budget_s,
        seconds=run.clock() - begun,
        n_workers=run.executor.n_workers,
        points=tuple(points),
        skipped=tuple(skipped),
        close_ups=close_ups,
        not_measured=not_measured(),
        fronts=found.fronts,
        beaten_presets=found.beaten_presets,
        advice=found.advice,
    )
    write_tradeoff(out, document)
    shutil.rmtree(folder)
    return document


def _point(
    run: Run, scan: Path, step: Step, path: Path, render: bool, known: dict[tuple, str]
) -> tuple[LadderPoint, Path | None, float]:
    """A point of the ladder, packed to `path`; the folder of the photographs that textured it, if any; and its seconds
    without what most other points reuse. `known` are the stages and bytes of earlier points, with their keys."""
    first = len(run.records)
    prepared = prepare_asked(run, scan, step.settings)
    textured = has_photographs(prepared)
    if not textured and not render:
        raise InvalidScan(
            str(scan),
            "no photograph that sees any of its points, and no pictures",
            "a scan with photographs, or pictures: without either nothing tells accuracy",
        )
    patches = resample(run, prepared) if textured else None
    n_shared = len(run.records) - first
    coded = code_prepared(run, prepared, patches, step.settings) if patches else None
    pack(run, prepared, coded, step.settings, scan.stem, path)
    with PackedFile(path) as packed:
        sizes = sizes_of(packed.load(), path.stat().st_size)
    records, quality = run.records[first:], coded.codes.summary if coded else None
    made = prepared.splats.folder, prepared.built, coded and coded.codes.folder, sizes.gpu_bytes
    point = LadderPoint(
        key=step.key,
        preset=step.preset,
        knob=step.knob,
        value=getattr(step.settings, step.knob) if step.knob else None,
        command=step.command,
        splats=prepared.splats.summary.n_splats,
        texture_psnr_db=_shown(quality.texture_psnr_db) if quality else None,
        visible_psnr_db=_shown(quality.visible_psnr_db) if quality else None,
        picture_psnr_db=None,
        mean_atoms=quality.mean_atoms if quality else 0.0,
        gpu_bytes=sizes.gpu_bytes,
        file_bytes=sizes.file_bytes,
        bytes_per_splat=sizes.bytes_per_splat,
        n_dictionary=coded.n_dictionary if coded else 0,
        seconds=sum(r.made_seconds for r in records),
        run_seconds=sum(r.seconds for r in records),
        peak_memory_bytes=max(r.peak_rss_bytes for r in records),
        reused=tuple(r.name for r in records if r.reused),
        settings=asdict(step.settings),
        n_cameras=len(prepared.scan.summary.cameras),
        same_as=known.get(made),
    )
    known.setdefault(made, step.key)
    return point, prepared.photos if textured else None, sum(r.seconds for r in records[n_shared:])


def _shown(psnr_db: float | None) -> float:
    """None stands for no error at all."""
    return BEST_DB if psnr_db is None else min(BEST_DB, psnr_db)


def _fullness(point: LadderPoint) -> tuple:
    """What orders points by how much of a scan they show: all of its points before cells, of cells the finest, else those without levels."""
    of_runs = point.settings["geometry"] == RUNS
    return point.settings["density"], not of_runs, point.splats if of_runs else -point.splats


def _pictures(
    run: Run, points: list[LadderPoint], packed: list[Path], photographs: Path | None, out: Path
) -> tuple[list[LadderPoint], tuple[CloseUp, ...]]:
    """The points with the time that a frame of each takes and its picture PSNR, and close-ups of all."""
    begun = time.perf_counter()
    run.progress.begin(PICTURES, 3)
    variants = [Variant(point.key, path) for point, path in zip(points, packed, strict=True)]
    close_ups: list[CloseUp] = []
    if photographs is not None:
        photos = Variant("photographs", packed[0], photographs)
        close_ups = run.paint(draw_close_ups, [photos, *variants], packed[0], photographs, out, SPOTS)
    run.progress.advance(PICTURES, 1, 0)
    fullest = max(range(len(points)), key=lambda i: _fullness(points[i]))
    psnrs = run.paint(picture_psnrs, variants, photographs, fullest)
    run.progress.advance(PICTURES, 1, 0)
    measured = [
        structs.replace(
            point,
            picture_psnr_db=psnr,
            frame_seconds=sum(timed.seconds.values()),
            device=timed.device,
            frame_px=(timed.width_px, timed.height_px),
        )
        for point, psnr, timed in zip(points, psnrs, run.paint(time_passes, variants), strict=True)
    ]
    run.progress.end(StageRecord(PICTURES, out, None, time.perf_counter() - begun, 0, 3, 0, False))
    return measured, tuple(close_ups)


def parsed_budget(text: str) -> float:
    """Seconds of texts as 90s, 10min, 2h, or a plain number of seconds. Raises ValueError saying what is allowed."""
    for unit, seconds in (("min", 60.0), ("h", 3600.0), ("s", 1.0), ("", 1.0)):
        if text.endswith(unit):
            try:
                found = float(text.removesuffix(unit)) * seconds
            except ValueError:
                break
            if 0 < found < math.inf:
                return found
            break
    raise ValueError(f"budget is {text!r}; allowed: a time above 0, as 90s, 10min or 2h")
