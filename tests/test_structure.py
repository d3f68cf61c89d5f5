"""What the house holds to: which file may import what, what is named in how many, and how much a floor holds."""

import ast
import re
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LAYERS = ("services", "renderer", "pipeline", "storage")  # each may import those after it
MOST_LINES = 300
MOST_ROOMS = 14  # files and folders of a folder of code, beside its __init__
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
    strangers = {
        path.relative_to(ROOT).as_posix(): packages(path) - allowed
        for folder in ALGORITHMS
        for path in (ROOT / folder).rglob("*.py")
    }
    assert len(strangers) > len(ALGORITHMS)
    assert not {name: found for name, found in strangers.items() if found}


def test_structure__algorithms_take_only_words_from_storage():
    """schema and errors, not the files that open zarr arrays."""
    allowed = {"storage.packed.schema", "storage.errors"}
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
    skipped = {
        ".git",
        ".venv",
        "__pycache__",
        ".pytest_cache",
        ".hypothesis",
        ".ruff_cache",
        ".mypy_cache",
        "demo-output",
        "demo-output-points",
        "demo-output-volume",
    }
    named = [
        path.relative_to(ROOT).as_posix()
        for path in ROOT.rglob("*")
        if path.is_file()
        and path.suffix in TEXT_SUFFIXES
        and not skipped & set(path.relative_to(ROOT).parts)
        and mine.search(path.read_text(errors="replace"))
    ]
    assert not named


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def arrows() -> dict[str, set[str]]:
    """By module of the project, the modules of it that its top level imports (what is imported within functions,
    for its price, may point anywhere)."""
    known = {module_of(path): path for path in CODE}
    found = {}
    for name, path in known.items():
        targets = set()
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                whole = {f"{node.module}.{alias.name}" for alias in node.names}
                targets |= {target if target in known else node.module for target in whole}
        found[name] = {target for target in targets if target in known and target != name}
    return found


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        return [error.args[1]]
    return []


def test_structure__no_circle_of_files():
    assert not circles(arrows())


def test_structure__no_circle_of_folders():
    """Folders as their files import each other; a folder and those within it are one house on two floors."""
    folder_of = {module_of(path): path.parent.relative_to(ROOT).as_posix() for path in CODE}
    graph: dict[str, set[str]] = {}
    for name, targets in arrows().items():
        here = folder_of[name]
        there = {folder_of[target] for target in targets}
        graph.setdefault(here, set()).update(
            f for f in there if f != here and not f.startswith(here + "/") and not here.startswith(f + "/")
        )
    assert not circles(graph)


def test_structure__a_folder_holds_about_a_dozen_rooms():
    folders = {path.parent for path in CODE}
    rooms = {
        folder.relative_to(ROOT).as_posix(): len({p for p in folder.glob("*.py") if p.name != "__init__.py"})
        for folder in folders
    }
    assert not {name: n for name, n in rooms.items() if n > MOST_ROOMS}


def test_structure__a_file_holds_one_idea():
    """At most MOST_LINES lines, but for what stands here with its reason."""
    allowed = {
        "pipeline/coding/omp_kernels.py": "kernels, each kept whole",
        "pipeline/coding/search/stepwise_kernels.py": "kernels, each kept whole",
        "pipeline/effects/ellipsoids/decision.py": "kernels, each kept whole",
        "pipeline/planning/knobs.py": "a table",
        "storage/packed/schema.py": "a table",
        "services/store/store.py": "all changes of a job's state, to be read beside each other",
        "services/api/uploads.py": "the tus protocol",
        "services/processes/evaluate.py": "the rows and figures of the paper",
        "services/processes/estimate.py": "a pilot, and what it says of the whole",
    }
    assert set(files_that(lambda path: len(path.read_text().splitlines()) > MOST_LINES)) <= set(allowed)


def test_structure__every_public_function_and_class_says_what_it_is():
    """Of modules. Methods are left out: most are those of a protocol (`init`, `run`, `finalise` of a stage), which says
    what they do."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    silent = [
        f"{path.relative_to(ROOT).as_posix()}: {node.name}"
        for path in CODE
        for node in ast.parse(path.read_text()).body
        if isinstance(node, kinds) and not node.name.startswith("_") and not ast.get_docstring(node)
    ]
    assert not silent
