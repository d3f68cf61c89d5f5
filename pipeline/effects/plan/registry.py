"""All effects there are: whatever stands in this folder and has an `EFFECT`."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

import pipeline.effects
from pipeline.effects.effect import Effect


@cache
def effects() -> dict[str, Effect]:
    """Every effect by its name, in the order of their rows."""
    modules = (
        importlib.import_module(f"pipeline.effects.{found.name}")
        for found in pkgutil.iter_modules(pipeline.effects.__path__)
    )
    found = [module.EFFECT for module in modules if hasattr(module, "EFFECT")]
    return {effect.name: effect for effect in sorted(found, key=lambda effect: (effect.order, effect.name))}
