"""Splats as a job's settings ask for them: whoever measures a setting makes of a scan what `compress` would."""

from __future__ import annotations

from pathlib import Path

from pipeline.planning.settings import Settings
from services.flow.points.runs import geometry_request
from services.flow.points.volumes import surface_request
from services.flow.prepare import Prepared, prepare, splats_of
from services.flow.run import Run


def prepare_asked(
    run: Run,
    scan: Path,
    settings: Settings,
    held_out: tuple[int, ...] = (),
    edited_maps: Path | None = None,
    effects: str | None = None,
) -> Prepared:
    """As `prepare`, by settings; `effects` in place of what they ask of effects."""
    return prepare(
        run,
        scan,
        settings.radius,
        settings.asked_effects if effects is None else effects,
        held_out,
        settings.density,
        surface_request(settings),
        settings.reading,
        edited_maps,
        settings.levels,
        geometry_request(settings),
    )


def splats_asked(run: Run, scan: Path, settings: Settings) -> Prepared:
    """As `splats_of`, by settings."""
    return splats_of(
        run,
        scan,
        settings.radius,
        settings.asked_effects,
        density=settings.density,
        surface=surface_request(settings),
        reading=settings.reading,
        levels=settings.levels,
        geometry=geometry_request(settings),
    )
