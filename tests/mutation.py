"""A mutation run: break one comparison, sign, constant or guard at a time and see whether a test notices.

    python tests/mutation.py --each 20 --seconds 600 [--only ksvd]

Changes no file; prints every survivor with its line, and the share that was killed. Not part of the tests.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib
import os
import random
import signal
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
CODING = ["tests/pipeline/coding", "tests/hard_cases/test_coding.py", "tests/hard_cases/test_learning.py"]
GEOMETRY = ["tests/pipeline/geometry", "tests/hard_cases/test_geometry.py"]
TARGETS = {  # file: tests that ought to notice
    "pipeline/coding/omp.py": CODING, "pipeline/coding/omp_kernels.py": CODING, "pipeline/coding/ksvd.py": CODING,
    "pipeline/geometry/chunks.py": GEOMETRY, "pipeline/geometry/positions.py": GEOMETRY,
    "pipeline/geometry/normals.py": GEOMETRY, "pipeline/geometry/frame.py": GEOMETRY,
    "pipeline/texture/projection.py": ["tests/pipeline/texture", "tests/hard_cases/test_projection.py"],
}
FLIPPED = {ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
           ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.And: ast.Or, ast.Or: ast.And, ast.BitAnd: ast.BitOr}


def mutants(tree: ast.Module) -> list[tuple[str, ast.Module]]:
    """Every mutant of a module: what was done where, and the module. Annotations and docstrings are left alone."""
    found = []
    for index, node in enumerate(ast.walk(tree)):
        for change in _changes(node):
            other = copy.deepcopy(tree)
            what = change(next(n for i, n in enumerate(ast.walk(other)) if i == index))
            found.append((f"line {node.lineno}: {what}", other))
    return found


def _changes(node: ast.AST) -> list:
    changes = []
    if isinstance(node, ast.Compare) and type(node.ops[0]) in FLIPPED:
        changes.append(lambda n: _replace(n.ops, 0, FLIPPED[type(n.ops[0])](), ast.unparse(n)))
    if isinstance(node, (ast.BinOp, ast.BoolOp)) and type(node.op) in FLIPPED and "|" not in ast.unparse(node):
        changes.append(lambda n: _set(n, "op", FLIPPED[type(n.op)]()))
    if isinstance(node, ast.If):
        changes.append(lambda n: _set(n, "test", ast.Constant(False)))
    if isinstance(node, ast.Constant) and type(node.value) in (int, float) and hasattr(node, "lineno"):
        changes.append(lambda n: _set(n, "value", n.value + 1))
    return changes


def _replace(ops: list, i: int, op: ast.AST, text: str) -> str:
    ops[i] = op
    return f"{text} -> {type(op).__name__}"


def _set(node: ast.AST, name: str, value) -> str:
    before = ast.unparse(node).split("\n")[0]
    setattr(node, name, value)
    return f"{before} -> {ast.unparse(node).splitlines()[0]}"


def survives(file: str, module: ast.Module, tests: list[str]) -> bool | None:
    """None where it took too long to tell.

    A child of this process, which has imported and compiled everything, runs the tests with the mutant's functions put
    in place; kernels are Python objects of numba and have to be replaced where they are used too.
    """
    child = os.fork()
    if not child:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        _put_in_place(importlib.import_module(file.removesuffix(".py").replace("/", ".")), module)
        os._exit(int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-k", "not jit_off and not million", *tests])))
    end = time.monotonic() + 150
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return status == 0
        time.sleep(0.05)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def _put_in_place(module, mutant: ast.Module) -> None:
    old = dict(vars(module))
    exec(compile(mutant, module.__file__, "exec"), vars(module))  # noqa: S102
    for name, value in old.items():
        new = vars(module)[name]
        if new is not value and not name.startswith("__"):
            for user in [m for n, m in list(sys.modules.items()) if n.startswith(("pipeline", "services", "tests"))]:
                if vars(user).get(name) is value:
                    setattr(user, name, new)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=20, help="mutants a file, chosen at random")
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="part of a file's name")
    options = parser.parse_args()
    rng, end = random.Random(options.seed), time.monotonic() + options.seconds
    plan = []
    for file in (f for f in TARGETS if options.only in f):
        every = mutants(ast.parse((ROOT / file).read_text()))
        plan += [(file, *m) for m in rng.sample(every, min(options.each, len(every)))]
    rng.shuffle(plan)
    for file in sorted({file for file, *_ in plan}):
        importlib.import_module(file.removesuffix(".py").replace("/", "."))
        assert survives(file, ast.parse((ROOT / file).read_text()), TARGETS[file]), f"{file}: tests fail as it is"
    outcomes = []
    for file, what, module in plan:
        if time.monotonic() > end:
            break
        outcomes.append(survives(file, module, TARGETS[file]))
        if outcomes[-1] is not False:
            print(f"{'survived' if outcomes[-1] else 'took too long'}: {file} {what}", flush=True)
    killed, told = outcomes.count(False), len(outcomes) - outcomes.count(None)
    print(f"{killed} of {told} mutants killed ({100 * killed / max(1, told):.0f} %), {len(plan)} planned")


if __name__ == "__main__":
    main()
