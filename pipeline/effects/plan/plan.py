"""The plan of a scan: for each effect whether it is on, and what decided."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace

from pipeline.effects.effect import Effect, Measured
from pipeline.effects.plan.registry import effects
from pipeline.effects.plan.request import AUTO, OFF, ON


@dataclass(frozen=True)
class Row:
    """One effect of a plan."""

    effect: str
    title: str
    request: str  # auto, on or off
    enabled: bool
    share: float | None  # of splats (or photographs) that it touches, 0 to 1; None where it was not measured
    measure: float | None  # what decided; None where it was not measured, as for what was asked to be off
    measures: str  # what that is, with its unit
    threshold: float | None  # None for what is on by request alone
    reason: str  # what decided, of this scan
    basis: str  # why the threshold stands where it does: what was measured on other scans
    costs: dict  # seconds, bytes, frame_share: of this scan if it is on, by what it cost on the scans of `measured_on`
    gives_db: float | None
    measured_on: str
    choice: str = ""  # which of several ways was taken, and why, where the effect has several


@dataclass(frozen=True)
class EffectPlan:
    """What a scan calls for, effect by effect."""

    rows: tuple[Row, ...]
    outcomes: dict[str, dict]  # of the effects that are on: what their encoders and shaders take
    measured: dict[str, dict] = field(default_factory=dict)  # the same of all that were measured, on or off

    @property
    def enabled(self) -> tuple[str, ...]:
        return tuple(row.effect for row in self.rows if row.enabled)

    def outcome(self, name: str) -> dict | None:
        """What an effect found, or None where it is off."""
        return self.outcomes.get(name)

    def to_json(self) -> list[dict]:
        return [asdict(row) for row in self.rows]


def plan_effects(
    measures: Mapping[str, Measured],
    request: Mapping[str, str],
    n_splats: int = 0,
    known: Mapping[str, Effect] | None = None,
) -> EffectPlan:
    """The plan of a scan with these measures, for this request (effect -> auto, on or off; auto where it says nothing).

    Guarantees: a pure function of its arguments; `auto` is on from the threshold on, and never for what is made by
    request alone; `off` is off whatever was measured; what needs another effect is off without it; `on` is on wherever
    the scan can be measured for it at all.
    """
    known = effects() if known is None else known
    rows: tuple[Row, ...] = ()
    for effect in known.values():
        possible = effect.needs is None or any(row.effect == effect.needs and row.enabled for row in rows)
        rows += (_row(effect, measures.get(effect.name), request.get(effect.name, AUTO), n_splats, possible),)
    on = {row.effect: measures[row.effect].outcome for row in rows if row.enabled}
    return EffectPlan(rows, on, {name: found.outcome for name, found in measures.items()})


def measured_effects(request: Mapping[str, str]) -> tuple[str, ...]:
    """The effects that a request leaves to measure: what is off, or needs what is, is not even looked at."""

    def wanted(name: str) -> bool:
        effect, choice = effects()[name], request.get(name, AUTO)
        if effect.needs and not wanted(effect.needs):
            return False
        return choice == ON or (choice == AUTO and not effect.by_request)

    return tuple(name for name in effects() if wanted(name))


def with_reason(plan: EffectPlan, effect: str, reason: str) -> EffectPlan:
    """The plan with a row that is not on by request, but for a reason that no threshold says."""
    rows = (replace(row, request=AUTO, reason=reason) if row.effect == effect else row for row in plan.rows)
    return replace(plan, rows=tuple(rows))


def _row(effect: Effect, found: Measured | None, request: str, n_splats: int, possible: bool) -> Row:
    wanted = request == ON or (
        request == AUTO and not effect.by_request and found is not None and found.value >= effect.threshold
    )
    enabled = wanted and found is not None and possible
    share = None if found is None else found.share
    worth = effect.worth
    return Row(
        effect.name,
        effect.title,
        request,
        enabled,
        share,
        None if found is None else found.value,
        effect.measures,
        None if effect.by_request else effect.threshold,
        _reason(effect, found, request, possible),
        effect.reason,
        {
            "seconds": worth.seconds_a_million * n_splats / 1e6,
            "bytes": round(worth.bytes_a_splat * n_splats * (share or 0.0)),
            "frame_share": worth.frame_share,
        },
        worth.gain_db,
        worth.measured_on,
    )


def _reason(effect: Effect, found: Measured | None, request: str, possible: bool) -> str:
    if request == OFF:
        return "asked to be off"
    if not possible:
        return f"only with {effect.needs}"
    if request == ON and found is not None:
        return "asked to be on"
    if effect.by_request:
        return "only where it is asked for"
    if found is None:
        return "nothing in this scan to measure it by"
    return f"{found.value:.3g} {'reaches' if found.value >= effect.threshold else 'stays below'} {effect.threshold:.3g}"
