"""Kernels as they are kept on disk: compiled by one process of a machine, for which the others wait, and again when
anything changes that is built into them."""

from __future__ import annotations

import hashlib
import os
from contextlib import ExitStack
from pathlib import Path
from types import CodeType, MethodType

import numpy as np
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

from storage.file_lock import hold


def compile_once(dispatcher):
    """The dispatcher that `numba.njit(cache=True)` made. Several workers call a kernel for the first time together: each
    would compile it, and of two that keep different signatures the later would forget the earlier's. The lock is a
    file beside what is kept; where there can be none, each compiles for itself.

    numba knows a kernel that it kept by the kernel's own file; here also by the functions of other files and by the
    constants that are built into it."""
    if not isinstance(dispatcher, Dispatcher):  # as with NUMBA_DISABLE_JIT
        return dispatcher
    kept = dispatcher.stats.cache_path
    if kept is None:
        return dispatcher
    function, compile_one, index = dispatcher.py_func, dispatcher.compile, dispatcher._cache._cache_file
    lock, of_file = Path(kept) / f"{function.__module__}.{function.__qualname__}.lock", index._source_stamp

    def compile_alone(self, signature):
        # numba's own lock first, as it is held by a thread that compiles what calls this kernel
        with global_compiler_lock, ExitStack() as held:
            index._source_stamp = (of_file, built_in(self))
            try:
                os.makedirs(kept, exist_ok=True)
                hold(held.enter_context(lock.open("ab")))
            except OSError:
                pass
            return compile_one(signature)

    dispatcher.compile = MethodType(compile_alone, dispatcher)
    return dispatcher


def built_in(dispatcher: Dispatcher) -> str:
    """A hash of the files of all functions that a kernel calls, at any depth, and of the constants that it reads."""
    files, values, waiting, seen = set(), set(), [dispatcher], {id(dispatcher)}
    while waiting:
        function = waiting.pop().py_func
        files.add(_stamp(function.__code__.co_filename))
        for name in sorted(_names(function.__code__)):
            value = function.__globals__.get(name)
            if isinstance(value, Dispatcher) and id(value) not in seen:
                seen.add(id(value))
                waiting.append(value)
            elif isinstance(value, np.ndarray):
                values.add(repr((name, value.dtype.str, value.shape, value.tobytes())))
            elif isinstance(value, bool | int | float | tuple):
                values.add(repr((name, value)))
    return hashlib.sha256(repr((sorted(files), sorted(values))).encode()).hexdigest()


def _names(code: CodeType) -> set[str]:
    within = (c for c in code.co_consts if isinstance(c, CodeType))
    return set(code.co_names).union(*map(_names, within))


def _stamp(file: str) -> tuple[str, int, int]:
    try:
        status = os.stat(file)
    except OSError:  # typed in, or in an archive
        return Path(file).name, 0, 0
    return Path(file).name, status.st_mtime_ns, status.st_size
