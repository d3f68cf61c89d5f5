"""What ../shared/design/DESIGN.md asks of the house: which file may import what, and what is named in how many."""

import ast
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LAYERS = ("services", "renderer", "pipeline", "storage")  # each may import those after it
ALGORITHMS = ("pipeline/coding", "pipeline/geometry", "pipeline/texture")
NUMERICS = {"numpy", "scipy", "numba"}
CODE = sorted(path for layer in LAYERS for path in (ROOT / layer).rglob("*.py"))
TEXT_SUFFIXES = {".py", ".md", ".toml", ".yml", ".yaml", ".glsl", ".html", ".js", ".json", ".txt", ".sh", ".lock", ""}


def imported(path: Path) -> set[str]:
    """Modules that a file imports, wherever in it the import stands; relative imports as absolute ones."""
    package = path.relative_to(ROOT).parent.parts
    modules = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            modules.add(".".join([*base, *([node.module] if node.module else [])]))
    return modules


def packages(path: Path) -> set[str]:
    return {module.split(".")[0] for module in imported(path)}


def files_that(claim) -> list[str]:
    return [path.relative_to(ROOT).as_posix() for path in CODE if claim(path)]


def called_names(path: Path) -> set[str]:
    calls = [node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    return {call.attr if isinstance(call, ast.Attribute) else getattr(call, "id", "") for call in calls}


@pytest.mark.parametrize("layer", LAYERS)
def test_structure__imports_run_one_way(layer):
    above = set(LAYERS[: LAYERS.index(layer)])
    turning_back = files_that(lambda path: path.relative_to(ROOT).parts[0] == layer and packages(path) & above)
    assert not turning_back


def test_structure__algorithms_see_numpy_scipy_numba_and_the_project_only():
    allowed = NUMERICS | {"pipeline", "storage"} | set(sys.stdlib_module_names)
    strangers = {path.relative_to(ROOT).as_posix(): packages(path) - allowed
                 for folder in ALGORITHMS for path in (ROOT / folder).rglob("*.py")}
    assert len(strangers) > len(ALGORITHMS)
    assert not {name: found for name, found in strangers.items() if found}


def test_structure__algorithms_take_only_words_from_storage():
    """schema and errors, not the files that open zarr arrays."""
    allowed = {"storage.schema", "storage.errors"}
    found = {module for folder in ALGORITHMS for path in (ROOT / folder).rglob("*.py") for module in imported(path)}
    assert {module for module in found if module.startswith("storage")} <= allowed


def test_structure__zarr_lives_in_storage():
    assert not files_that(lambda path: "zarr" in packages(path) and path.relative_to(ROOT).parts[0] != "storage")


def test_structure__the_gl_context_is_made_in_one_file():
    makers = {"create_context", "create_standalone_context"}
    assert len(files_that(lambda path: called_names(path) & makers)) <= 1


def test_structure__dask_is_named_in_two_files_at_most():
    assert len(files_that(lambda path: packages(path) & {"dask", "distributed"})) <= 2


def test_structure__no_file_names_the_machine_it_was_made_on():
    places = [ROOT, *([Path(sys.prefix)] if sys.prefix != sys.base_prefix else [])]
    mine = re.compile("|".join([re.escape(str(p)) for p in places if len(p.parts) > 2] + [r"/(tmp|home|Users)/\w"]))
    skipped = {".git", ".venv", "__pycache__", ".pytest_cache", ".hypothesis", "demo-output"}
    named = [path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*")
             if path.is_file() and path.suffix in TEXT_SUFFIXES and not skipped & set(path.relative_to(ROOT).parts)
             and mine.search(path.read_text(errors="replace"))]
    assert not named
