"""Texts of the pipeline, which name knobs, as somebody at a terminal knows them: by options."""

from __future__ import annotations

import re

from pipeline.planning.knobs import BY_NAME

_LONG = "|".join(name for name in BY_NAME if "_" in name)  # no other word looks like these
_ANY = "|".join(BY_NAME)
_KNOB = re.compile(rf"\b(?:{_LONG})\b(?![-/.])|^(?:{_ANY})(?=: )")


def as_options(text: str) -> str:
    """The text with knobs as options of `compress`.

    >>> as_options("budget_bytes: 3 bytes a splat; allowed: 4 and more")
    '--budget-bytes: 3 bytes a splat; allowed: 4 and more'
    """
    return _KNOB.sub(lambda found: "--" + found[0].replace("_", "-"), text)
