"""A mutation run: break one comparison, sign, constant or guard at a time and see whether a test notices.

    python tests/mutation.py [--only omp] [--each 40] [--seconds 600] [--seed 0] [--at 81:37 166:26]

Changes no file; prints every survivor with its line and column, and the share that was killed. Not part of the tests.
Tests are collected once, timed once, and run fastest first in a fork of the process that holds the mutant; those that
never enter the function that was changed are left out. Kernels run as plain Python, for to compile a mutant takes
longer than to run it: tests that take more than SECONDS_AS_PYTHON that way, or fail, are left out too.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib
import json
import os
import random
import resource
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numba
import pytest
from _pytest.runner import runtestprotocol
from scipy.stats import beta

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
PURSUIT = [
    "tests/pipeline/coding/test_omp.py",
    "tests/pipeline/coding/search/test_certified.py",
    "tests/hard_cases/test_coding.py",
    "tests/pipeline/stages/texture/test_multipliers.py",
]
BEAM = ["tests/pipeline/coding/test_beam.py", "tests/hard_cases/test_coding.py"]
LEARNING = ["tests/pipeline/coding/test_ksvd.py", "tests/hard_cases/test_learning.py"]
GEOMETRY = ["tests/pipeline/geometry", "tests/hard_cases/test_geometry.py"]
TARGETS = {  # file: tests that ought to notice
    "pipeline/coding/omp.py": PURSUIT,
    "pipeline/coding/omp_kernels.py": PURSUIT,
    "pipeline/coding/beam/scores.py": BEAM,
    "pipeline/coding/beam/nodes.py": BEAM,
    "pipeline/coding/beam/passes.py": BEAM,
    "pipeline/coding/beam/weights.py": BEAM,
    "pipeline/coding/beam/by_gram.py": BEAM,
    "pipeline/coding/beam/by_steps.py": BEAM,
    "pipeline/coding/ksvd.py": LEARNING,
    "pipeline/geometry/chunks.py": GEOMETRY,
    "pipeline/geometry/positions.py": GEOMETRY,
    "pipeline/geometry/normals.py": GEOMETRY,
    "pipeline/geometry/frame.py": GEOMETRY,
    "pipeline/geometry/cliplines.py": GEOMETRY,
    "pipeline/geometry/ellipsoids.py": GEOMETRY,
    "pipeline/texture/projection.py": ["tests/pipeline/texture", "tests/hard_cases/test_projection.py"],
}
LEFT_OUT = "not jit_off and not million"  # a process of its own, which imports the file as it is; too slow
FLIPPED = {
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
SECONDS, SECONDS_AS_PYTHON = 120, 15  # of processor time, of a test that takes part
CPU_SECONDS = 8  # of one mutant, beside twice what its tests take when watched: who takes longer does not end
MEMORY_BYTES = 8 << 30


# ---- mutants


def mutants(tree: ast.Module) -> list[tuple[ast.AST, str, ast.Module]]:
    """Every mutant of a module: where, what was done, and the module. Annotations and docstrings are left alone."""
    found, hints = [], _annotations(tree)
    for index, node in enumerate(ast.walk(tree)):
        for change in [] if node in hints else _changes(node):
            other = copy.deepcopy(tree)
            what = change(next(n for i, n in enumerate(ast.walk(other)) if i == index))
            found.append((node, f"{node.lineno}:{node.col_offset} {what}", other))
    return found


def _annotations(tree: ast.Module) -> set[ast.AST]:
    roots = [getattr(node, name, None) for node in ast.walk(tree) for name in ("annotation", "returns")]
    return {node for root in roots if root is not None for node in ast.walk(root)}


def _changes(node: ast.AST) -> list:
    changes = []
    if isinstance(node, ast.Compare):
        changes += [
            lambda n, i=i, op=op: _replace(n.ops, i, FLIPPED[type(op)](), ast.unparse(n))
            for i, op in enumerate(node.ops)
            if type(op) in FLIPPED
        ]
    if isinstance(node, (ast.BinOp, ast.BoolOp, ast.AugAssign)) and type(node.op) in FLIPPED:
        changes.append(lambda n: _set(n, "op", FLIPPED[type(n.op)]()))
    if isinstance(node, ast.UnaryOp):
        changes.append(lambda n: _set(n, "op", ast.UAdd() if isinstance(n.op, ast.USub) else ast.USub()))
    if isinstance(node, (ast.If, ast.IfExp)):
        changes.append(lambda n: _set(n, "test", ast.Constant(False)))
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        changes.append(lambda n: _set(n, "value", n.value + 1))
    return changes


def _replace(ops: list, i: int, op: ast.AST, text: str) -> str:
    ops[i] = op
    return f"{text} -> {type(op).__name__}"


def _set(node: ast.AST, name: str, value) -> str:
    before = ast.unparse(node).split("\n")[0]
    setattr(node, name, value)
    return f"{before} -> {ast.unparse(node).splitlines()[0]}"


# ---- putting one in place


def _put_in_place(module, node: ast.AST, mutant: ast.Module) -> None:
    """Run again what the change reaches inside its file, and hand the new objects to all who hold the old ones.

    Kernels of other files that were compiled with a changed kernel of this one keep the old one inside.
    """
    old = dict(vars(module))
    as_python = _holds_kernels(module.__file__)
    body = mutant.body[1:] if as_python else _reached(mutant, node.lineno)
    numba.config.DISABLE_JIT = as_python
    for statement in body:
        for decorator in getattr(statement, "decorator_list", []):  # numba's cache does not tell constants apart
            if isinstance(decorator, ast.Call):
                decorator.keywords = [k for k in decorator.keywords if k.arg != "cache"]
    exec(compile(ast.fix_missing_locations(ast.Module(body, [])), module.__file__, "exec"), vars(module))
    changed = {id(value): vars(module)[name] for name, value in old.items() if vars(module)[name] is not value}
    for user in [m for n, m in list(sys.modules.items()) if n.startswith(("pipeline", "services", "tests"))]:
        for name, value in list(vars(user).items()):
            if id(value) in changed and not isinstance(value, (int, float)):
                setattr(user, name, changed[id(value)])


def _holds_kernels(file: str) -> bool:
    return file.endswith("_kernels.py")


def _module_of(file: str):
    return importlib.import_module(file.removesuffix(".py").replace("/", "."))


def _reached(tree: ast.Module, line: int) -> list[ast.stmt]:
    """The statements of a module that the change is in or that name one of them, in order."""
    reached = [s for s in tree.body if _first_line(s) <= line <= s.end_lineno]
    grown = True
    while grown:
        names = {name for s in reached for name in _defined(s)}
        more = [
            s
            for s in tree.body
            if s in reached
            or any(isinstance(n, ast.Name) and n.id in names and isinstance(n.ctx, ast.Load) for n in ast.walk(s))
        ]
        grown, reached = len(more) > len(reached), more
    return reached


def _defined(statement: ast.stmt) -> list[str]:
    if isinstance(statement, (ast.FunctionDef, ast.ClassDef)):
        return [statement.name]
    if isinstance(statement, (ast.Import, ast.ImportFrom)):
        return [a.asname or a.name for a in statement.names]
    return [n.id for n in ast.walk(statement) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)]


def _first_line(statement: ast.stmt) -> int:
    return min([statement.lineno, *[d.lineno for d in getattr(statement, "decorator_list", [])]])


# ---- running tests


class Session:
    """The collected tests of one group of files; `work` gets them, once, inside of pytest's own loop."""

    def __init__(self, work):
        self.work = work

    def pytest_sessionstart(self):
        from hypothesis import Phase, settings  # not earlier: pytest has to see it first

        settings.register_profile(
            "mutation", phases=[Phase.explicit, Phase.generate], derandomize=True, database=None, deadline=None
        )
        settings.load_profile("mutation")

    def pytest_runtestloop(self, session):
        self.work(session.items)
        return True


def in_a_fork(work, cpu_seconds: float) -> tuple[int, str]:
    """Exit status of `work`, a function that returns what is to be told, and that; negative where it was killed."""
    reads, writes = os.pipe()
    child = os.fork()
    if not child:
        os.close(reads)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        resource.setrlimit(resource.RLIMIT_CPU, (int(cpu_seconds), int(cpu_seconds) + 1))
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
        try:
            told = work()
        except BaseException as error:
            told = json.dumps(f"{type(error).__name__} before the tests")
        with os.fdopen(writes, "w") as pipe:
            pipe.write(told)
        os._exit(0)
    os.close(writes)
    with os.fdopen(reads) as pipe:
        told = pipe.read()
    return os.waitpid(child, 0)[1], told


def timed(items, files: list[str]) -> list[tuple]:
    """The tests that take part, fastest first: (seconds, passed, functions of the project entered), test."""

    def work(item):
        for file in filter(_holds_kernels, files):
            tree = ast.parse((ROOT / file).read_text())
            _put_in_place(_module_of(file), tree.body[1], tree)
        return json.dumps(_entered(item))

    as_python = any(map(_holds_kernels, files))
    limit = SECONDS_AS_PYTHON if as_python else SECONDS
    found = [(in_a_fork(lambda item=item: work(item), limit), item) for item in items]
    taking_part = [(json.loads(told), item) for (status, told), item in found if status == 0]
    if as_python:  # sums in another order may pick another of two atoms as good
        taking_part = [(told, item) for told, item in taking_part if told[1]]
    print(
        f"{len(taking_part)} of {len(items)} tests take part: the others take more than {limit} s, or need numba",
        flush=True,
    )
    return sorted(taking_part, key=lambda pair: pair[0][0])


def _entered(item) -> tuple[float, bool, list[str]]:
    seen = set()

    def note(frame, event, arg):
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(str(ROOT / "pipeline")):
            seen.add(f"{code.co_filename}:{code.co_qualname.split('.')[0]}")

    start = time.process_time()
    with _profiled(note):
        passed = _passes(item)
    return time.process_time() - start, passed, sorted(seen)


@contextmanager
def _profiled(note):
    threading.setprofile(note)
    sys.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(None)
        threading.setprofile(None)


def _passes(item) -> bool:
    return not any(report.failed for report in runtestprotocol(item, log=False, nextitem=None))


def first_that_fails(items) -> str:
    for item in items:
        if not _passes(item):
            return item.nodeid
    return ""


# ---- the run


def run_group(files: list[str], tests: list[str], options, deadline: float) -> list[tuple[str, str, str]]:
    """(file, mutant, who noticed or "" or "crashed or too long") of the mutants of files that the same tests are to
    notice."""
    outcomes = []

    def work(items):
        order = timed(items, files)
        failing = [item.nodeid for (_, passed, _), item in order if not passed]
        assert not failing, f"tests fail as the code is: {failing}"
        for file in files:  # else what kills the mutants may be the way they are put in place
            tree = ast.parse((ROOT / file).read_text())
            noticed = _outcome(file, tree.body[2], tree, order[:20])
            assert not noticed, f"{file}, unchanged but put in place: {noticed}"
        for file, node, what, mutant in chosen(files, options):
            if time.monotonic() > deadline:
                break
            relevant = _that_enter(order, file, node, mutant)
            outcomes.append((file, what, _outcome(file, node, mutant, relevant)))
            print(f"{outcomes[-1][2] or 'SURVIVED'} <- {file}:{what}", flush=True)

    pytest.main(
        ["-q", "-s", "-p", "no:cacheprovider", "--durations=0", "-k", LEFT_OUT, *tests], plugins=[Session(work)]
    )
    return outcomes


def _outcome(file, node, mutant, tests) -> str:
    def work():
        _put_in_place(_module_of(file), node, mutant)
        return json.dumps(first_that_fails([item for _, item in tests]))

    status, told = in_a_fork(work, CPU_SECONDS + 2 * sum(seconds for (seconds, *_), _ in tests))
    return json.loads(told) if status == 0 and told else "crashed or too long"


def _that_enter(order, file, node, mutant) -> list:
    """The tests that enter the function which holds the change; all of them where that cannot be seen from outside."""
    inside = [s for s in mutant.body if _first_line(s) <= node.lineno <= s.end_lineno]
    compiled = inside and getattr(inside[0], "decorator_list", None) and not _holds_kernels(file)
    if compiled or not inside or not isinstance(inside[0], ast.FunctionDef):
        return order
    name = f"{ROOT / file}:{inside[0].name}"
    return [pair for pair in order if name in pair[0][2]]


def chosen(files: list[str], options) -> list:
    """All mutants of the files, or as many of each, by chance, as asked for; in an order by chance."""
    rng, plan = random.Random(options.seed), []
    for file in files:
        every = [
            (file, *m) for m in mutants(ast.parse((ROOT / file).read_text())) if m[1].startswith(tuple(options.at))
        ]
        plan += rng.sample(every, min(options.each or len(every), len(every)))
    rng.shuffle(plan)
    return plan


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=0, help="mutants a file, chosen at random; 0 for all")
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="part of a file's name")
    parser.add_argument("--at", nargs="+", default=[""], help="only mutants at these places, as LINE:COLUMN")
    options = parser.parse_args()
    deadline, outcomes = time.monotonic() + options.seconds, []
    for tests, as_python in dict.fromkeys((tuple(tests), _holds_kernels(file)) for file, tests in TARGETS.items()):
        files = [
            f for f, t in TARGETS.items() if t == list(tests) and _holds_kernels(f) == as_python and options.only in f
        ]
        if files:
            outcomes += run_group(files, list(tests), options, deadline)
    _print_result(outcomes)


def _print_result(outcomes) -> None:
    for file in sorted({file for file, *_ in outcomes}):
        of_file = [who for f, _, who in outcomes if f == file]
        print(f"{file}: {len(of_file) - of_file.count('')} of {len(of_file)} killed")
    killed = sum(bool(who) for *_, who in outcomes)
    late = sum(who == "crashed or too long" for *_, who in outcomes)
    least = beta.ppf(0.05, killed, len(outcomes) - killed + 1) if killed else 0.0
    print(
        f"{killed} of {len(outcomes)} killed ({100 * killed / max(1, len(outcomes)):.1f} %; were it a sample, above "
        f"{100 * least:.0f} % at 95 % confidence), {late} of them by a crash or by not ending"
    )


if __name__ == "__main__":
    main()
