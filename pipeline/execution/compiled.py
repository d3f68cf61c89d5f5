"""How loops are compiled: to machine code that is kept on disk, and runs beside others of its process."""

from __future__ import annotations

import numba

FAST = {"nnan", "nsz", "reassoc", "contract"}  # sums in vectors


def kernel(cache: bool = True, **options):
    """A function that Python calls."""
    return numba.njit(cache=cache, nogil=True, **options)


def part(cache: bool = True, **options):
    """A function of a kernel, which is always built into it. Left to the compiler, a process that compiles a kernel has
    it call the part as it was built alone, and one that loads it a copy made in the kernel: where sums may be reordered
    these round differently, and bytes would depend on what a process compiled before."""
    return numba.njit(cache=cache, nogil=True, forceinline=True, **options)
