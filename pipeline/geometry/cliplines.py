"""Cliplines in 3 x 4 bits: the line a x + b y + c = 0 in the splat's tangent square, normalised to its radius.

Paper: HPG 2021, section 3.5.2. The side where a x + b y + c >= 0 is kept; x and y run over [-1, 1].
"""

from __future__ import annotations

import numpy as np

PEAK = 7  # coefficients are -7..7 sevenths: 15 of the 16 codes, so that zero is one of them


def encode_cliplines(line: np.ndarray) -> np.ndarray:
    """Codes (n,) uint32 of 12 bits: a lowest, then b, then c. `line` (n, 3) with (a, b) of unit length, |c| <= 1."""
    step = (np.clip(np.round(np.asarray(line) * PEAK), -PEAK, PEAK) + PEAK).astype(np.uint32)
    return step[:, 0] | step[:, 1] << 4 | step[:, 2] << 8


def decode_cliplines(code: np.ndarray) -> np.ndarray:
    """Lines (n, 3) float64 of codes (n,)."""
    step = np.stack([code & 15, code >> 4 & 15, code >> 8 & 15], axis=1)
    return step / PEAK - 1.0
