"""`tradeoff.json` as types; as `renderer.report.document` has those of report.json."""

from __future__ import annotations

from typing import Any

from renderer.report.document import Part
from renderer.report.evaluation_document import CloseUp


class LadderScan(Part, frozen=True):
    """The scan whose ladder it is."""

    name: str
    n_cameras: int


class LadderPoint(Part, frozen=True):
    """One point of the ladder: a preset, or the chosen settings with one knob at another value. PSNR at most BEST_DB
    where nothing is lost, null where it was not measured. `seconds` count stages that an earlier point ran,
    `run_seconds` do not; `command` are the arguments of compress that make it; `same_as` is the key of an earlier point
    of the same splats, whose knob changes nothing of this scan."""

    key: str
    preset: str | None
    knob: str | None
    value: Any
    command: str
    splats: int
    texture_psnr_db: float | None
    visible_psnr_db: float | None
    picture_psnr_db: float | None
    mean_atoms: float
    gpu_bytes: int
    file_bytes: int
    bytes_per_splat: float
    n_dictionary: int
    seconds: float
    run_seconds: float
    peak_memory_bytes: int
    reused: tuple[str, ...]
    settings: dict[str, Any]
    n_cameras: int
    frame_seconds: float | None = None
    device: str | None = None
    frame_px: tuple[int, int] | None = None
    same_as: str | None = None


class LadderStep(Part, frozen=True):
    """A point that the budget of time left out."""

    key: str
    command: str


class Beaten(Part, frozen=True):
    """A preset, and another that is better in bytes, seconds or PSNR and worse in none."""

    preset: str
    by: str


class Advice(Part, frozen=True):
    """For a texture PSNR: the preset of fewest bytes that reaches it, and the point of fewest bytes of all, by key."""

    wanted_db: float
    preset: str | None
    cheapest: str


class LadderSummary(Part, frozen=True):
    """What the points say together: by cost, the keys of those that no other beats, the cheapest first."""

    fronts: dict[str, tuple[str, ...]]
    beaten_presets: tuple[Beaten, ...]
    advice: tuple[Advice, ...]


class TradeoffDocument(Part, frozen=True):
    """tradeoff.json. `splats` are those of the first point, the chosen settings; `not_measured` says what and why."""

    scan: LadderScan
    splats: int
    preset: str
    budget_s: float
    seconds: float
    n_workers: int
    points: tuple[LadderPoint, ...]
    skipped: tuple[LadderStep, ...]
    close_ups: tuple[CloseUp, ...]
    not_measured: str | None
    fronts: dict[str, tuple[str, ...]]
    beaten_presets: tuple[Beaten, ...]
    advice: tuple[Advice, ...]
