"""What a Dask worker does before its first task: it imports all stages and loads a kernel, which takes 0.7 s that would
else be the first stage's. Imported for its effect (`distributed.worker.preload`).

And how it ends: at once, as what is left of a process then is its interpreter, which takes a second to go."""

from __future__ import annotations

import atexit
import logging
import multiprocessing
import os
import pkgutil
import sys
from importlib import import_module

import numpy as np

import pipeline.stages
from pipeline.effects.plan.registry import effects
from pipeline.geometry.chunks import median_split
from storage.packed.schema import CHUNK

# A worker that is asked to end while it tells the scheduler that it lives says so by a stack trace; what else becomes
# of a lost scheduler is told by other lines.
logging.getLogger("distributed.worker").addFilter(lambda record: "during heartbeat" not in record.getMessage())

for module in pkgutil.walk_packages(pipeline.stages.__path__, "pipeline.stages."):
    import_module(module.name)
effects()
median_split(np.zeros((CHUNK + 1, 3)))


def dask_setup(worker) -> None:
    """Called by Dask in each worker: where it is a process that a nanny started, it goes without taking itself apart."""
    if multiprocessing.parent_process() is not None:
        atexit.register(_end)


def _end() -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)
