"""Pages of the photographs beside the packed file: where splats are so wide that their 32x32 texels show less than
these do.

What is coded, and drawn where it is resident, are pieces of the photographs themselves (2020, section 4;
docs/PAGES.md). Pages are made once the packed file is (services/flow/beside.py), from the photographs that its textures
are of; here stands what decides.
"""

from __future__ import annotations

import numpy as np

from pipeline.effects.block import Block, Sources
from pipeline.effects.effect import Effect, Measured, Worth
from pipeline.splats.cameras import sharpness
from storage.packed.schema import PATCH_SIZE

BINS_AN_OCTAVE, FINEST_OCTAVE, OCTAVES = 16, -4, 20  # of widths in px, for the median


def widths_px(block: Block) -> np.ndarray:
    """Photo pixels across the splats of a block that a photograph textures, (n,) float64: sqrt of the area of their
    squares there."""
    cameras, centre = block.sources.cameras, block.centre + block.sources.origin
    found = []
    for i, camera in enumerate(cameras):
        rows = np.flatnonzero(block.camera == i)
        per_area = np.abs(sharpness(camera, centre[rows], block.frame[2][rows]))
        found.append(2 * block.radius[rows] * np.sqrt(per_area))
    return np.concatenate(found) if found else np.empty(0)


def _measure_block(block: Block) -> dict:
    with np.errstate(divide="ignore"):
        octave = np.log2(widths_px(block)) - FINEST_OCTAVE
    bins = BINS_AN_OCTAVE * OCTAVES
    return {
        "widths": np.bincount(np.clip(octave * BINS_AN_OCTAVE, 0, bins - 1).astype(np.int64), minlength=bins).tolist()
    }


def _conclude(sums: list[dict], sources: Sources) -> Measured:
    if not sources.cameras:  # maps of stations are cut where somebody asks for it
        return Measured(0.0)
    counts = np.sum([s["widths"] for s in sums], axis=0)
    if not counts.sum():
        return Measured(0.0)
    middle = np.searchsorted(np.cumsum(counts), counts.sum() / 2) + 0.5
    median_px = float(2.0 ** (middle / BINS_AN_OCTAVE + FINEST_OCTAVE))
    first_wider = int((np.log2(EFFECT.threshold * PATCH_SIZE) - FINEST_OCTAVE) * BINS_AN_OCTAVE)
    return Measured(median_px / PATCH_SIZE, float(counts[first_wider:].sum() / counts.sum()))


EFFECT = Effect(
    name="pages",
    title="Photographs in pages beside the packed file, drawn where splats are wider than their textures show",
    measures="photo pixels that a texel of a splat spans, median",
    threshold=0.5,
    reason="close-ups against the photographs, atoms to pages: fountain_p11 +0.2 dB at 0.23, +0.3 at 0.41, +0.9 at 0.57, +1.4 at 0.80; atoms then "
    "keep 0.97, 0.92, 0.73 and 0.52 of the photographs' fine detail, pages 1.05 to 0.86; monstree +0.8 at 0.46, +1.0 at 0.63, +1.3 at 0.88",
    worth=Worth(
        "fountain_p11 at density 0.125, draft: pages of JPEG at 90; bytes lie beside the packed file",
        seconds_a_million=23,
        gain_db=0.9,
    ),
    measure_block=_measure_block,
    conclude=_conclude,
    order=28,
)
