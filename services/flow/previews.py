"""Previews of a packed file, as files."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from pipeline.effects.exposure.photographs import read_photo
from pipeline.summaries import ScanRead
from renderer.evaluate.previews import make_previews
from renderer.report.document import ViewMeasured
from storage.packed.packed import PackedFile
from storage.work import work


def previews_of(
    packed: Path, ingest: Path, out: Path, on_view: Callable[[int, int], None] = lambda done, total: None
) -> list[ViewMeasured]:
    """Previews of a packed file into `out`, beside the photographs that the ingest stage decoded, or from where its
    stations stood."""
    with PackedFile(packed) as opened:
        scene = opened.load()
    photo = partial(read_photo, ingest) if scene.header.cameras else None
    stations = () if scene.header.cameras else work.summary(ingest, ScanRead).stations
    return make_previews(scene, out, photo, progress=on_view, stations=stations)
