"""Texture from the maps of laser stations, for scans without photographs: where a splat stands for many points, it
shows what they show.

Its stages run in services/flow/maps.py, which needs all points of the scan, not those alone that became splats.
"""

from __future__ import annotations

from pipeline.effects.block import Sources
from pipeline.effects.effect import Effect, Measured, Worth
from pipeline.summaries import ScanRead


def has_maps(scan: ScanRead) -> bool:
    """Whether the scan of this summary of the ingest has stations, and colours of its own to draw, and no photographs,
    which show more."""
    return bool(scan.stations) and scan.has_colors and not scan.cameras


def _conclude(sums: list[dict], sources: Sources) -> Measured | None:
    if not has_maps(sources.scan):
        return Measured(0.0)
    return Measured(sources.scan.n_points / sources.n_splats, 1.0)


EFFECT = Effect(
    name="station_maps",
    title="Splats of a laser scan are textured from what its stations saw",
    measures="points of the scan that a splat stands for",
    threshold=4.0,
    reason="against photographs, fountain_3stations gains 1.7 dB by maps with a tenth of its points and 3.0 with a hundredth; "
    "before splats had sizes it lost 0.4 with all of them, and neither gained nor lost with every second",
    worth=Worth(
        "fountain_3stations, draft, density 0.1, two held-out photographs of 768 px, a loaded machine",
        seconds_a_million=95,
        bytes_a_splat=1.8,
        gain_db=1.7,
    ),
    conclude=_conclude,
    order=25,
)
