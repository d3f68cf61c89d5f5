"""One Gaussian a splat: what programs for 3D Gaussian splatting draw.

A disc of radius r becomes a Gaussian of SIGMA_IN_RADII r, flat along the normal; an ellipsoid one with its axes. Its
peak is nearly opaque, so that the nearest surface shows.

Reference: Kerbl et al., "3D Gaussian splatting for real-time radiance field rendering", SIGGRAPH 2023.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.exports.cloud import Cloud

# Tried from 0.3 to 0.8 on photographs of fountain_p11 that textured nothing (benchmarks/exports.py): below 0.5 what
# lies behind shines through, above 0.6 textures blur.
SIGMA_IN_RADII = 0.55
FLATNESS = 0.02  # sigma along the normal over that across it; no viewer divides by nothing then
OPACITY = 0.99  # the most that such programs draw
SH_0 = 0.28209479177387814  # the constant spherical harmonic: color = 0.5 + SH_0 * dc


@dataclass(frozen=True)
class Gaussians:
    """Rows correspond."""

    position: np.ndarray  # (n, 3) float64 against `origin`
    rotation: (
        np.ndarray
    )  # (n, 4) float64 unit quaternions x, y, z, w with w >= 0: of the axes of the Gaussian to the scan's
    sigma: np.ndarray  # (n, 3) float64
    color: np.ndarray  # (n, 3) float64 sRGB in [0, 1]
    opacity: float
    origin: tuple[float, float, float]
    splat: np.ndarray  # (n,) int64: which of the file's splats this is one of

    def __len__(self) -> int:
        return len(self.position)

    def of(self, rows: np.ndarray | slice) -> Gaussians:
        """Some of them."""
        names = ("position", "rotation", "sigma", "color", "splat")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    @property
    def dc(self) -> np.ndarray:  # (n, 3) coefficient of the constant spherical harmonic
        return (self.color - 0.5) / SH_0


def gaussians_of(cloud: Cloud) -> Gaussians:
    """The Gaussian of each splat, in the same order."""
    lengths = np.linalg.norm(cloud.axes, axis=2)
    directions = cloud.axes / lengths[..., None]
    rotation = Rotation.from_matrix(directions.swapaxes(1, 2)).as_quat(canonical=True)
    sigma = SIGMA_IN_RADII * lengths
    sigma[~cloud.solid, 2] = FLATNESS * sigma[~cloud.solid, 0]
    return Gaussians(cloud.position, rotation, sigma, cloud.color, OPACITY, cloud.origin, cloud.splat)


def turned(gaussians: Gaussians, rotation: Rotation) -> Gaussians:
    """The same Gaussians in turned axes."""
    quaternions = (rotation * Rotation.from_quat(gaussians.rotation)).as_quat(canonical=True)
    return replace(gaussians, position=rotation.apply(gaussians.position), rotation=quaternions)


def to_y_up(up: np.ndarray) -> Rotation:
    """The shortest turn that takes the direction `up` (3,) to +y, which SPZ and glTF call up."""
    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    axis = np.cross(up, [0.0, 1.0, 0.0])
    sine, cosine = np.linalg.norm(axis), up[1]
    if sine < 1e-12:
        return Rotation.from_rotvec([0.0, 0.0, 0.0] if cosine > 0 else [np.pi, 0.0, 0.0])
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine))
