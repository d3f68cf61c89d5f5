"""Shader sources: files of renderer/shaders, with `#include "file"` lines filled in and `#define`s put on top."""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files

_VERSION = "#version 430"
_INCLUDE = re.compile(r'^#include "([\w.]+)"$', re.MULTILINE)


def shader_source(name: str, **defines: int) -> str:
    """The whole text of one shader for one variant. A define of 0 is left out, so that `#ifdef` serves for flags."""
    heads = [_VERSION] + [f"#define {key} {value}" for key, value in defines.items() if value]
    return "\n".join(heads) + "\n" + with_includes(name)


@cache
def with_includes(name: str) -> str:
    """The text of a file with its includes filled in, without version and defines."""
    text = files("renderer").joinpath("shaders", name).read_text(encoding="utf-8")
    return _INCLUDE.sub(lambda match: with_includes(match[1]), text)
