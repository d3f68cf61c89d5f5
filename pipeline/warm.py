"""What a Dask worker does before its first task: it imports all stages and loads a kernel, which takes 0.7 s that would
else be the first stage's. Imported for its effect (`distributed.worker.preload`)."""

from __future__ import annotations

import pkgutil
from importlib import import_module

import numpy as np

import pipeline.stages
from pipeline.effects.plan.registry import effects
from pipeline.geometry.chunks import median_split
from storage.packed.schema import CHUNK

for module in pkgutil.walk_packages(pipeline.stages.__path__, "pipeline.stages."):
    import_module(module.name)
effects()
median_split(np.zeros((CHUNK + 1, 3)))
