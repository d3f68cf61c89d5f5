"""What the service tells of itself: options, presets, the schemas of documents, and how webhooks are signed."""

from __future__ import annotations

import functools
from dataclasses import asdict

from fastapi import APIRouter

from pipeline.planning.knobs import KNOBS, Knob
from pipeline.planning.settings import DEFAULT_PRESET, PRESETS
from services.api.context import Owner, Settings
from services.jobs.webhooks import owner_secret
from services.problems import Problem

router = APIRouter(tags=["published"])
SCHEMAS = ("report.json", "evaluate.json", "tradeoff.json", "estimate.json")
_TYPES = {int: "integer", float: "number", str: "string"}


@router.get("/options")
def get_options() -> list[dict]:
    """Each option's name, type, default, domain, meaning, what it buys and what it costs; `value` is that of the
    default preset. The seed is none of them: it is a job's own field."""
    return [_option(knob) for knob in KNOBS if knob.name != "seed"]


def _option(knob: Knob) -> dict:
    return {
        "name": knob.name,
        "type": _TYPES[knob.kind],
        "value": getattr(PRESETS[DEFAULT_PRESET], knob.name),
        "domain": knob.domain,
        "help": knob.help,
        "buys": knob.buys,
        "costs": knob.costs,
    }


@router.get("/presets")
def get_presets() -> list[dict]:
    """Every preset with all of its settings."""
    return [
        {"name": name, "default": name == DEFAULT_PRESET, "settings": asdict(settings)}
        for name, settings in PRESETS.items()
    ]


@router.get("/webhook-secret")
def get_webhook_secret(owner: Owner, settings: Settings) -> dict:
    """What the caller's webhooks are signed with, by Standard Webhooks."""
    return {"secret": owner_secret(settings, owner)}


@router.get("/schemas/{name}")
def get_schema(name: str) -> dict:
    """The JSON Schema (2020-12) of report.json, which every job leaves, of evaluate.json and tradeoff.json, which the
    commands of these names write, and of estimate.json, what `splatpress estimate --json` prints."""
    if name not in SCHEMAS:
        raise Problem(404, "not-found", f"no schema {name[:80]!r}", hint=f"allowed: {', '.join(SCHEMAS)}")
    return _schemas()[name]


@functools.cache
def _schemas() -> dict[str, dict]:
    from renderer.report.document import Report, schema_of
    from renderer.report.estimate_document import EstimateDocument
    from renderer.report.evaluation_document import EvaluationDocument
    from renderer.report.tradeoff_document import TradeoffDocument

    kinds = (Report, EvaluationDocument, TradeoffDocument, EstimateDocument)
    return {name: schema_of(kind, name) for name, kind in zip(SCHEMAS, kinds, strict=True)}
