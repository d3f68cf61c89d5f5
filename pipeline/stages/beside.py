"""Stages that the catalogue runs by itself, beside the packed file: no other stage reads them.

The row of such a stage in `pipeline/catalogue.py` has `beside=True`; its file has `asked(given)`, which makes the stage
of a scan as splats, or None where the job does not call for it, and `ARRAYS`, where it makes any: rows as those of
`storage.work.schema`.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from pipeline.catalogue import CATALOGUE, StageEntry
from pipeline.effects.block import Sources
from pipeline.effects.plan.plan import EffectPlan
from pipeline.execution.stage import Stage
from pipeline.planning.settings import Settings
from storage.work.schema import WORK_ARRAYS, WorkArray


@dataclass(frozen=True)
class Given:
    """What a stage beside the packed file may be made of."""

    settings: Settings
    sources: Sources
    effects: EffectPlan
    photos: Path | None = None  # the photographs that splats are textured from; None where no splat has one
    in_one_light: bool = False  # these are as the effect exposure left them
    maps: Path | None = None  # what stations saw, where that textures splats
    log_gain: tuple[tuple[float, float, float], ...] = ()  # of each station's light, by channel


def stages_beside(given: Given, catalogue: tuple[StageEntry, ...] = CATALOGUE) -> list[Stage]:
    """The stages of the catalogue that the job calls for, in its order."""
    modules = (module_of(entry) for entry in catalogue if entry.beside)
    return [stage for module in modules if (stage := module.asked(given)) is not None]


def work_arrays(catalogue: tuple[StageEntry, ...] = CATALOGUE) -> tuple[WorkArray, ...]:
    """The whole table of arrays of work folders: of the pipeline, and of what stands beside it."""
    beside = (getattr(module_of(entry), "ARRAYS", ()) for entry in catalogue if entry.beside)
    return (*WORK_ARRAYS, *(row for rows in beside for row in rows))


def module_of(entry: StageEntry):
    """The file of a stage, imported."""
    return import_module("pipeline." + entry.file.removesuffix(".py").replace("/", "."))
