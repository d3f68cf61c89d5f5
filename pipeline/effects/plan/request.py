"""What a job may ask of effects: `auto` (the scan decides), `on` or `off` for each, as one canonical text.

The text is a setting, so it must be the same for the same request: `cliplines=off,relighting=on`, by name, without
those that are `auto`.
"""

from __future__ import annotations

from collections.abc import Iterable

from pipeline.effects.plan.registry import effects

AUTO, ON, OFF = CHOICES = ("auto", "on", "off")
ALL = "all"  # a name that stands for every effect, as in `all=off`


def parse_request(text: str | Iterable[str]) -> dict[str, str]:
    """What is asked for, by effect, of `name=choice` parts, joined by commas or one by one; later parts win.

    Raises: ValueError naming the part and what is allowed.

    >>> parse_request("all=off,exposure=on")["exposure"], parse_request("")["exposure"]
    ('on', 'auto')
    """
    asked = dict.fromkeys(effects(), AUTO)
    for part in _parts(text):
        name, _, choice = (piece.strip() for piece in part.partition("="))
        if choice not in CHOICES:
            raise ValueError(f"effect {part!r}; allowed: NAME={'|'.join(CHOICES)}")
        if name not in asked and name != ALL:
            raise ValueError(f"effect {name!r}; allowed: {', '.join(asked)}, {ALL}")
        asked |= dict.fromkeys(asked, choice) if name == ALL else {name: choice}
    return asked


def canonical_request(text: str | Iterable[str]) -> str:
    """The one text of a request.

    >>> canonical_request(["exposure=off", "cliplines=on", "mip_levels=auto"])
    'cliplines=on,exposure=off'
    """
    return ",".join(f"{name}={choice}" for name, choice in sorted(parse_request(text).items()) if choice != AUTO)


def asked_by(settings: dict) -> dict[str, str]:
    """What was asked of each effect by the settings that a packed file names; `auto` of what they do not say, or not
    rightly.

    >>> asked_by({"effects": "exposure=off"})["exposure"], asked_by({"effects": 3})["exposure"]
    ('off', 'auto')
    """
    text = settings.get("effects")
    try:
        return parse_request(text if isinstance(text, str) else "")
    except ValueError:
        return parse_request("")


def _parts(text: str | Iterable[str]) -> list[str]:
    texts = [text] if isinstance(text, str) else text
    return [part.strip() for t in texts for part in t.split(",") if part.strip()]
