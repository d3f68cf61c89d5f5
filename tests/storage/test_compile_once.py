"""A kernel that was kept is compiled again where what is built into it has changed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PART = """
import numba
from storage.compile_once import compile_once
SHIFT = {shift}
@numba.njit(cache=True, forceinline=True)
def part(x):
    return {term}
"""
KERNEL = """
import numba
from made_part import part, SHIFT
from storage.compile_once import compile_once
kernel = compile_once(numba.njit(cache=True)(lambda x: part(x) + SHIFT))
@compile_once
@numba.njit(cache=True)
def outer(x):
    return 10 * kernel(x)
print(outer(1))
"""


def _said(folder: Path) -> tuple[str, int]:
    """What the kernel gives, and how many were compiled for it."""
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{folder}", "NUMBA_DEBUG_CACHE": "1"}
    environment["NUMBA_CACHE_DIR"] = str(folder / "kept")
    command = [sys.executable, str(folder / "made_kernel.py")]
    *told, given = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    return given, sum("data saved" in line for line in told)


def test_compile_once__what_is_built_in_from_another_file_counts(tmp_path):
    part = tmp_path / "made_part.py"
    (tmp_path / "made_kernel.py").write_text(KERNEL)
    part.write_text(PART.format(shift=2, term="x"))
    assert _said(tmp_path) == ("30", 3)
    assert _said(tmp_path) == ("30", 0)
    for shift, term in ((3, "x"), (3, "x + 1")):
        part.write_text(PART.format(shift=shift, term=term))
        given, compiled = _said(tmp_path)
        assert given == {"x": "40", "x + 1": "50"}[term] and compiled >= 2
