"""What each effect adds to the shaders: code behind a define, compiled into no program that does without.

A module of this folder is the shader part of the effect of the same name in `pipeline/effects`; it has a `PART`.
Nothing lists them: they are found.
"""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import dataclass
from functools import cache

from storage.packed.schema import Batch


@dataclass(frozen=True)
class ShaderPart:
    """What stands in shaders behind `#ifdef define`, in programs of these passes: of the batches whose `flag` (a field
    of `storage.packed.schema.Batch`) is set, or, without a flag, of all while the scene draws the effect."""

    define: str
    passes: tuple[str, ...]
    flag: str | None = None


@cache
def shader_parts() -> dict[str, ShaderPart]:
    """Every shader part by the name of its effect."""
    modules = {
        found.name: importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__)
    }
    return {name: module.PART for name, module in sorted(modules.items()) if hasattr(module, "PART")}


def defines_of(stage: str, drawn: frozenset[str], batch: Batch | None = None) -> dict[str, int]:
    """The defines of a pass's program, 0 where it does without; `drawn` are the effects that the scene draws."""
    found = {}
    for name, part in shader_parts().items():
        if stage in part.passes:
            found[part.define] = int(
                name in drawn if part.flag is None else batch is not None and getattr(batch, part.flag)
            )
    return found
