"""Kernels that tests have compiled by now, for a service whose folder of compiled kernels is its own: what it does not
find there it compiles, for most of a minute."""

from __future__ import annotations

import shutil
from pathlib import Path

from numba.core.caching import UserProvidedCacheLocator

from tests.services.service_process import ROOT

ROOMS = ("storage", "pipeline", "renderer")


def give_kernels(cache: Path, code: Path = ROOT, but: tuple[str, ...] = ()) -> int:
    """Copy them to `cache`, as $NUMBA_CACHE_DIR of code that lies in `code`; those of the folders `but` are left to be
    compiled there. Returns how many files that were."""
    n = 0
    for made in (path for room in ROOMS for path in (ROOT / room).rglob("__pycache__/*.nb?")):
        of = made.parent.parent.relative_to(ROOT)
        if of.as_posix() not in but:
            folder = cache / UserProvidedCacheLocator.get_suitable_cache_subpath(str(code / of / "a.py"))
            folder.mkdir(parents=True, exist_ok=True)
            shutil.copy(made, folder)
            n += 1
    return n
