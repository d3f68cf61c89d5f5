"""Calls on a worker that may see nothing of the runner's disk: files of a job go there and come back by its place."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from services.jobs.scheduler import SchedulerLink
from storage import place


def call_with_files(
    link: SchedulerLink, folder: Path, there: Path, name: str, function: Callable, *arguments: Any, **how: Any
) -> Any:
    """`function(*arguments)` on a worker; paths among the arguments that lie in `folder`, this machine's copy of the
    folder `there`, are the worker's copies of them. What it writes into a folder that it was given is in `folder`
    afterwards."""
    if folder == there:
        return link.call(name, function, *arguments, **how)
    place.put_folder(folder, there)
    result = call_there(link, there, name, function, *_moved(arguments, folder, there), **how)
    place.bring_folder(there, folder)
    return result


def call_there(link: SchedulerLink, there: Path, name: str, function: Callable, *arguments: Any, **how: Any) -> Any:
    """`function(*arguments)` on a worker, on copies of its own of what lies below `there`, where that is a bucket."""
    if not place.is_remote(there):
        return link.call(name, function, *arguments, **how)
    return link.call(name, _with_copies, there, function, arguments, **how)


def _with_copies(there: Path, function: Callable, arguments: tuple) -> Any:
    """On the worker: files that exist are brought, what is new afterwards goes up."""
    with tempfile.TemporaryDirectory(dir=place.scratch(there)) as made:
        folder = Path(made)
        _visited(arguments, lambda path: _bring(path, there, folder))
        result = function(*_moved(arguments, there, folder))
        place.put_folder(folder, there)
        return result


def _bring(path: Path, there: Path, folder: Path) -> Path:
    if path.is_relative_to(there):
        target = folder / path.relative_to(there)
        target.parent.mkdir(parents=True, exist_ok=True)
        if place.is_file(path):
            place.bring_file(path, target)
    return path


def _moved(value: Any, source: Path, target: Path) -> Any:
    """A copy of nested values with every path below `source` below `target`."""
    return _visited(value, lambda p: target / p.relative_to(source) if p.is_relative_to(source) else p)


def _visited(value: Any, visit: Callable[[Path], Path]) -> Any:
    if isinstance(value, Path):
        return visit(value)
    if isinstance(value, (list, tuple)):
        return type(value)(_visited(item, visit) for item in value)
    if isinstance(value, dict):
        return {key: _visited(item, visit) for key, item in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: _visited(getattr(value, f.name), visit) for f in fields(value) if f.init})
    return value
