"""Files that appear under their name only when they are whole."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from storage.whole import whole


def write_whole(path: Path, data: bytes) -> None:
    """Write aside, then rename: a reader sees the old file or the new one, never a part. Makes the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as partial:
        partial.write_bytes(data)


def write_json(path: Path, data: dict) -> None:
    """Write strict JSON: what is not a finite number becomes null, numpy's scalars and arrays become plain ones."""
    text = json.dumps(strict(data), indent=2, ensure_ascii=False, allow_nan=False)
    # A file name that is no UTF-8 reaches us with lone surrogates; they are written as question marks.
    write_whole(path, (text + "\n").encode("utf-8", errors="replace"))


def strict(value):
    """A copy of nested data that every JSON parser takes."""
    if isinstance(value, dict):
        return {str(key): strict(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [strict(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return strict(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
