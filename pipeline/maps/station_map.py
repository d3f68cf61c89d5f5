"""What a station saw, as pictures: colour with alpha, and the distance, on a map of the polar-capped sphere.

Distances are 16-bit codes of even steps of their logarithm, between the nearest and the farthest surface of the map: a
step of one code is 0.014 % of the distance where these are 1 : 10,000 apart.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from pipeline.cameras.polar_capped import PolarCapped

LAST_CODE = 65534
NOTHING = 65535  # the code of a texel that shows no surface


@dataclass(frozen=True)
class MapFrame:
    """What the pictures of a station's map are to be read with."""

    station: int
    centre: tuple[float, float, float]  # absolute, in the scan's unit
    height_px: int
    nearest: float  # what code 0 stands for
    farthest: float  # what LAST_CODE stands for; above `nearest`

    @property
    def projection(self) -> PolarCapped:
        return PolarCapped(self.centre, self.height_px)

    @property
    def codes_an_e_fold(self) -> float:
        """Codes that a distance grows by when it becomes e times as large."""
        return LAST_CODE / float(np.log(self.farthest / self.nearest))

    @staticmethod
    def from_json(data: dict) -> MapFrame:
        return MapFrame(**{**data, "centre": tuple(data["centre"])})

    def to_json(self) -> dict:
        return asdict(self)


@dataclass(frozen=True)
class StationMap:
    """The pictures of one station; rows and columns as pipeline/cameras/polar_capped.py has them."""

    frame: MapFrame
    color: np.ndarray  # (h, 6 h, 4) uint8: sRGB, and alpha, 0 where no surface was seen
    depth: np.ndarray  # (h, 6 h) uint16 codes, NOTHING where alpha is 0


def encode_distances(distance: np.ndarray, frame: MapFrame) -> np.ndarray:
    """uint16 codes of distances, rounded; NOTHING where a distance is not finite.

    Guarantees: between `nearest` and `farthest` a decoded distance is off by half a step at most.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        code = np.rint(np.log(distance / frame.nearest) * frame.codes_an_e_fold)
    return np.where(np.isfinite(distance), np.clip(code, 0, LAST_CODE), NOTHING).astype(np.uint16)


def decode_distances(code: np.ndarray, frame: MapFrame) -> np.ndarray:
    """Distances (float64) of codes; infinite where there is no surface."""
    return np.where(code == NOTHING, np.inf, frame.nearest * np.exp(code / frame.codes_an_e_fold))
