"""Whether documents fit the schemas that are published for them."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema_rs

from services.api.published import get_schema


def misfits(document: Path) -> list[str]:
    """What in a report.json or an evaluate.json its published schema does not allow."""
    validator = jsonschema_rs.validator_for(get_schema(document.name))
    found = validator.iter_errors(json.loads(document.read_text()))
    return [f"{error.instance_path}: {error.message}" for error in found]
