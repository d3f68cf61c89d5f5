"""Kernels are compiled by one process of a machine; the others wait for it and load what it kept on disk."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from types import MethodType

from numba.core.compiler_lock import global_compiler_lock

from storage.file_lock import hold


def compile_once(dispatcher):
    """The dispatcher that `numba.njit(cache=True)` made. Several workers call a kernel for the first time together: each
    would compile it, and of two that keep different signatures the later would forget the earlier's. The lock is a
    file beside what is kept; where there can be none, each compiles for itself."""
    if not hasattr(dispatcher, "py_func"):  # as with NUMBA_DISABLE_JIT
        return dispatcher
    kept = dispatcher.stats.cache_path
    if kept is None:
        return dispatcher
    function, compile_one = dispatcher.py_func, dispatcher.compile
    lock = Path(kept) / f"{function.__module__}.{function.__qualname__}.lock".replace("<", "").replace(">", "")

    def compile_alone(self, signature):
        # numba's own lock first, as it is held by a thread that compiles what calls this kernel
        with global_compiler_lock, ExitStack() as held:
            try:
                os.makedirs(kept, exist_ok=True)
                hold(held.enter_context(lock.open("ab")))
            except OSError:
                pass
            return compile_one(signature)

    dispatcher.compile = MethodType(compile_alone, dispatcher)
    return dispatcher
