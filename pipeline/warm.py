"""What a Dask worker does before its first task: it imports all stages and loads a kernel, which takes 0.7 s that would else be
the first stage's. Imported for its effect (`distributed.worker.preload`)."""

from __future__ import annotations

import pkgutil
from importlib import import_module

import numpy as np

import pipeline.stages
from pipeline.effects.registry import effects
from pipeline.geometry.chunks import median_split
from storage.schema import CHUNK

for module in pkgutil.iter_modules(pipeline.stages.__path__):
    import_module(f"pipeline.stages.{module.name}")
effects()
median_split(np.zeros((CHUNK + 1, 3)))
