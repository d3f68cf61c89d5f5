"""Texts of the pipeline, which name knobs, as somebody at a terminal knows them: by options."""

from __future__ import annotations

import re

from pipeline.planning.knobs import BY_NAME


def as_options(text: str) -> str:
    """The text with knobs as options of `compress`.

    >>> as_options("budget_bytes: 3 bytes a splat; allowed: 4 and more")
    '--budget-bytes: 3 bytes a splat; allowed: 4 and more'
    """
    long = "|".join(name for name in BY_NAME if "_" in name)  # no other word looks like these
    knob = rf"\b(?:{long})\b(?![-/.])|^(?:{'|'.join(BY_NAME)})(?=: | is )"
    return re.sub(knob, lambda found: "--" + found[0].replace("_", "-"), text)
