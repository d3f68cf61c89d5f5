"""How many threads the libraries of a process use, and work shared by threads, for callers outside the pipeline's tasks
(those hold to one)."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import threadpoolctl


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_all(work: Callable[[int], None], items: range, n_threads: int) -> None:
    """Call `work` with every item. BLAS has one thread in each of `n_threads`; with one, it is left as it is.

    Re-raises what the first item that failed raised.
    """
    if n_threads <= 1 or len(items) <= 1:
        for item in items:
            work(item)
        return
    with one_blas_thread(), ThreadPoolExecutor(min(n_threads, len(items))) as pool:
        for done in [pool.submit(work, item) for item in items]:
            done.result()


def one_blas_thread():
    """A context in which BLAS keeps to one thread: factors of thin matrices take longer with more on a busy machine."""
    return _loaded_libraries(len(sys.modules)).limit(limits=1, user_api="blas")


def one_thread_a_library():
    """A context in which BLAS and OpenMP, whichever are loaded, keep to one thread."""
    return _loaded_libraries(len(sys.modules)).limit(limits=1)


@lru_cache(maxsize=1)
def _loaded_libraries(n_modules: int) -> threadpoolctl.ThreadpoolController:
    """Those of this process, looked for again once more modules are imported, which may have brought one: a look takes
    2 ms, setting threads a hundredth of that."""
    return threadpoolctl.ThreadpoolController()
