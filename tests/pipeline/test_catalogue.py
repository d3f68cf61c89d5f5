"""That the catalogue is the pipeline: all stages, in an order that has each after what it reads, under their files."""

import inspect
import pkgutil
from dataclasses import is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pipeline
from pipeline.catalogue import BY_NAME, CATALOGUE
from pipeline.planning.knobs import KNOBS
from services.docs.stages import PATH, document

ROOT = Path(pipeline.__file__).parent


def stages() -> dict[str, str]:
    """Every stage of the package: its file by its name."""
    return {kind.name: Path(inspect.getfile(kind)).relative_to(ROOT).as_posix() for kind in stage_classes()}


def stage_classes() -> list[type]:
    """Every class of the package with the three steps of a stage."""
    found = []
    for info in pkgutil.walk_packages(pipeline.__path__, "pipeline."):
        module = import_module(info.name)
        for _, kind in inspect.getmembers(module, inspect.isclass):
            is_stage = all(callable(getattr(kind, step, None)) for step in ("init", "run", "finalise"))
            if is_stage and kind.__module__ == info.name and isinstance(getattr(kind, "name", None), str):
                found.append(kind)
    return found


def test_catalogue__has_every_stage_under_its_file_and_nothing_else():
    assert stages() == {entry.name: entry.file for entry in CATALOGUE}


def test_catalogue__tasks_and_summaries_have_types():
    for kind in stage_classes():
        told = get_type_hints(kind.run)["return"], get_type_hints(kind.finalise)["return"]
        assert not any(t is dict or t is Any for t in told), kind
        assert told[0] in (None, type(None)) or is_dataclass(_of(told[0])), kind


def _of(told: type) -> type:
    """Of what a task may tell, or not, what it tells."""
    return next((t for t in get_args(told) if t is not type(None)), told)


def test_catalogue__has_each_stage_after_those_that_it_reads():
    names = [entry.name for entry in CATALOGUE]
    assert len(set(names)) == len(names)
    for entry in CATALOGUE:
        assert all(names.index(source) < names.index(entry.name) for source in entry.reads), entry.name


def test_catalogue__knobs_name_stages_of_it():
    assert {knob.stage for knob in KNOBS} <= set(BY_NAME)


def test_pipeline__the_document_is_current():
    text = PATH.read_text()
    assert document(text) == text, "write it again: python -m services.docs.stages"
