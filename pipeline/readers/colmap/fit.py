"""Which sparse model fits the points: colours of points are compared with the photographs at the places they project to.

Several models of one workspace have the same photographs in other coordinates; only that of fused.ply puts its points
where their colours are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.readers.colmap.model import Model
from pipeline.readers.colmap.photos import Photos, find_photos, read_photo
from pipeline.readers.files.members import Members
from pipeline.readers.files.spelling import shown
from pipeline.readers.ply.ply import Vertices
from pipeline.scan import Camera
from storage.errors import InvalidScan, UnsupportedScan

N_POINTS = 2_000
N_PHOTOS = 6  # of each model
FIRST_POINTS = 1 << 16
# The best of two models has half the colour error of the other, or they are alike: a point that is in no photo counts as
# BLIND, as much as two colours that have nothing to do with each other.
CLEAR = 0.7
BLIND = 0.35


@dataclass(frozen=True)
class Fit:
    """How well a model fits: the mean difference of colours, 0 to 1."""

    model: Model
    photos: Photos
    error: float


def best_model(members: Members, models: list[Model], vertices: Vertices) -> tuple[Fit, list[str]]:
    """The model that fits the points best, and warnings that name the others.

    Raises: InvalidScan where no model has a photograph that can be read.
    """
    position, color = _sample(vertices)
    fits, errors = [], []
    for model in models:
        try:
            photos = find_photos(members, model.photos)
            fits.append(Fit(model, photos, _error(members, photos, position, color)))
        except (InvalidScan, UnsupportedScan) as error:
            errors.append(error)
    if not fits:
        raise errors[0]
    # Of equal ones that with more photographs, then the first.
    fits.sort(key=lambda f: (round(f.error, 3), -len(f.photos.files)))
    best = fits[0]
    others = [f"{shown(f.model.folder)} ({len(f.photos.files)} photographs, {f.error:.3f})" for f in fits[1:]]
    others += [f"{shown(m.folder)} (unusable)" for m in models if m.folder not in {f.model.folder for f in fits}]
    what = f"{shown(best.model.folder)} ({len(best.photos.files)} photographs, {best.error:.3f})"
    clear = len(fits) < 2 or best.error < CLEAR * fits[1].error
    said = "fits the points best" if clear else "is used, though another fits nearly as well"
    hint = "" if clear else " (choose: --sparse-model FOLDER)"
    text = f"of several models {what} {said}, by the mean difference of colours; not used: {', '.join(others)}{hint}"
    return best, [text]


def _sample(vertices: Vertices) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions (n, 3) and colours (n, 3) of some of the first points."""
    pieces = list(vertices.slice(0, min(FIRST_POINTS, vertices.count), FIRST_POINTS))
    position = np.concatenate([piece.position for piece in pieces])
    rows = np.arange(0, len(position), max(1, len(position) // N_POINTS))
    rows = rows[np.isfinite(position[rows]).all(axis=1)]
    colors = [piece.color for piece in pieces if piece.color is not None]
    return position[rows], np.concatenate(colors)[rows].astype(np.float64) if colors else None


def _error(members: Members, photos: Photos, position: np.ndarray, color: np.ndarray | None) -> float:
    """The mean over points of the least difference in any photo: what hides a point in one shows it in another."""
    least = np.full(len(position), BLIND)
    for i in np.unique(np.linspace(0, len(photos.files) - 1, N_PHOTOS).astype(int)):
        camera = photos.cameras[i]
        pixel, inside = _projected(camera, position)
        if not inside.any():
            continue
        if color is None:
            least[inside] = 0.0
            continue
        picture = read_photo(members, photos.files, int(i))
        x, y = np.minimum(pixel[inside].astype(int), [camera.width_px - 1, camera.height_px - 1]).T
        off = np.abs(picture[y, x] - color[inside]).mean(axis=1) / 255
        least[inside] = np.minimum(least[inside], off)
    return float(least.mean()) if len(least) else BLIND


def _projected(camera: Camera, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) of positions, and which lie in the photo (n,)."""
    local = (position - camera.centre) @ np.array(camera.rotation).T
    depth = np.where(local[:, 2] > 0, local[:, 2], np.nan)
    focal, middle = (camera.fx_px, camera.fy_px), (camera.cx_px, camera.cy_px)
    with np.errstate(invalid="ignore", over="ignore"):
        pixel = local[:, :2] / depth[:, None] * focal + middle
        inside = ((pixel >= 0) & (pixel < (camera.width_px, camera.height_px))).all(axis=1)
    return np.where(inside[:, None], pixel, 0), inside
