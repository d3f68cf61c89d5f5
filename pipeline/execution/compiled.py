"""How loops are compiled: to machine code that is kept on disk, and runs beside others of its process."""

from __future__ import annotations

import numba
from llvmlite import ir
from numba.core import cgutils, types
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


def _no_hint(array, start, n):
    return None


@intrinsic
def _fetched(typing_context, array, start, n):
    """In compiled code: a hint that n elements of a contiguous array, from `start`, are read soon."""
    n_line = 64 // (array.dtype.bitwidth // 8)

    def with_hints(context, builder, signature, arguments):
        made = context.make_array(array)(context, builder, arguments[0])
        byte = ir.IntType(8).as_pointer()
        hint = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), [byte] + 3 * [ir.IntType(32)]), "llvm.prefetch.p0"
        )
        counted = ir.IntType(64)
        with cgutils.for_range_slice(builder, counted(0), arguments[2], counted(n_line)) as (at, _):
            element = builder.gep(made.data, [builder.add(arguments[1], at)])
            builder.call(hint, [builder.bitcast(element, byte), *(ir.IntType(32)(x) for x in (0, 3, 1))])
        return context.get_dummy_value()

    return types.none(array, types.uintp, types.uintp), with_hints


fetched = _no_hint if numba.config.DISABLE_JIT else _fetched  # type: ignore[attr-defined]
