"""/v1/options, /v1/presets, /v1/webhook-secret: what may be asked for, and how answers are signed."""

from __future__ import annotations

from dataclasses import asdict

from fastapi import APIRouter

from pipeline.settings import ALLOWED, PRESETS, Settings
from services.api.context import Owner
from services.api.context import Settings as ServiceSettings
from services.webhooks import owner_secret

router = APIRouter(tags=["words"])
_HELP = {
    "dictionary_bits": "bits of an atom's number: 256, 4,096 or 65,536 atoms at most",
    "weight_bits": "bits of a weight",
    "max_atoms": "atoms that a splat may take",
    "target_psnr_db": "where a splat is good enough and takes no further atom",
    "iterations": "of k-SVD",
    "training_splats": "that the dictionary is learned from",
    "radius": "of every splat, in the scan's unit; by default the median distance to the 4th neighbour",
}
_CHOICES = ("dictionary_bits", "weight_bits")


@router.get("/options")
def get_options() -> list[dict]:
    """Each option's name, type, default, domain and meaning; `value` is that of the preset `balanced`."""
    return [_option(name, text) for name, text in _HELP.items()]


def _option(name: str, text: str) -> dict:
    value, allowed = getattr(Settings(), name), ALLOWED.get(name)
    domain = {"enum": list(allowed)} if name in _CHOICES else {"minimum": allowed[0], "maximum": allowed[1]} if allowed else \
        {"exclusiveMinimum": 0}
    return {"name": name, "type": "number" if name in ("radius", "target_psnr_db") else "integer", "value": value,
            "domain": domain, "help": text}


@router.get("/presets")
def get_presets() -> list[dict]:
    return [{"name": name, "settings": asdict(settings)} for name, settings in PRESETS.items()]


@router.get("/webhook-secret")
def get_webhook_secret(owner: Owner, settings: ServiceSettings) -> dict:
    """What the caller's webhooks are signed with, by Standard Webhooks."""
    return {"secret": owner_secret(settings, owner)}
