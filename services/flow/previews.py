"""Previews of a packed file, as files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from renderer.evaluate.previews import make_previews
from renderer.report.document import ViewMeasured
from storage.packed.packed import PackedFile
from storage.work import arrays


def previews_of(
    packed: Path, ingest: Path, out: Path, on_view: Callable[[int, int], None] = lambda done, total: None
) -> list[ViewMeasured]:
    """Previews of a packed file into `out`, beside the photographs that the ingest stage decoded."""
    with PackedFile(packed) as opened:
        scene = opened.load()
    read_photo = (lambda i: np.asarray(arrays.opened(ingest, f"photo_{i}")[:])) if scene.header.cameras else None
    return make_previews(scene, out, read_photo, progress=on_view)
