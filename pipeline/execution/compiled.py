"""How loops are compiled: to machine code that is kept on disk, and runs beside others of its process."""

from __future__ import annotations

import numba
from numba.core import cgutils
from numba.extending import intrinsic

from storage.compile_once import compile_once

FAST = {"nnan", "nsz", "reassoc", "contract"}  # sums in vectors


def kernel(cache: bool = True, **options):
    """A function that Python calls."""
    jit = numba.njit(cache=cache, nogil=True, **options)
    return lambda function: compile_once(jit(function))


def part(cache: bool = True, **options):
    """A function of a kernel, which is always built into it. Left to the compiler, a process that compiles a kernel has
    it call the part as it was built alone, and one that loads it a copy made in the kernel: where sums may be reordered
    these round differently, and bytes would depend on what a process compiled before."""
    return kernel(cache, forceinline=True, **options)


def _as_it_is(array):
    return array


@intrinsic
def _borrowed(typing_context, array):
    """In compiled code: the array without its count of users. A view, and a tuple that is passed on, count an array's
    users up and down with a locked addition for each, which in short loops takes longer than the loops. Whoever borrows
    keeps the array itself alive: it must be an argument of the kernel."""

    def without_count(context, builder, signature, arguments):
        made = context.make_array(array)(context, builder, arguments[0])
        made.meminfo = cgutils.get_null_value(made.meminfo.type)
        made.parent = cgutils.get_null_value(made.parent.type)
        return made._getvalue()

    return array(array), without_count


borrowed = _as_it_is if numba.config.DISABLE_JIT else _borrowed  # type: ignore[attr-defined]
