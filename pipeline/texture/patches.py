"""The patches of a block of splats: each from its own camera's photograph, with its average and its energy."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.execution.compiled import kernel
from pipeline.texture.projection import homographies, is_in_front, is_whole, project_corners
from pipeline.texture.resample import (
    PATCH_DIM,
    PROBES,
    Window,
    disc_weights,
    resample_into,
    resampling_error,
    window_bounds,
)
from storage.packed.schema import NO_CAMERA, PATCH_SIZE, Camera

ReadWindow = Callable[[int, int, int, int, int], np.ndarray]  # camera, left, top, right, bottom -> (h, w, 3) uint8


@dataclass(frozen=True)
class Patches:
    """Patches as they are stored, and what coding needs to know of them."""

    texel: np.ndarray  # (n, PATCH_DIM) uint8, (row, column, rgb)
    average: np.ndarray  # (n, 3) float32, exact, in 255ths
    energy: np.ndarray  # (n,) float32: squared norm of texel / 255 - average / 255
    resampling_error: float  # sum of squared differences over all probes
    n_probes: int  # values it is summed over
    n_flagged: int  # patches that are not wholly what a photograph shows: without a camera, or beyond its edge


@dataclass(frozen=True)
class Block:
    """A block of splats, and the photographs that show them."""

    cameras: tuple[Camera, ...]
    read_window: ReadWindow
    origin: tuple[float, float, float]
    centre: np.ndarray  # (n, 3) decoded, against the origin
    frame: tuple[np.ndarray, np.ndarray]  # tangents u and v, (n, 3) each
    radius: float | np.ndarray  # (n,), or one for all
    camera: np.ndarray  # (n,) uint16
    color: np.ndarray  # (n, 3) uint8: of splats without a camera


def make_patches(block: Block, first_splat: int, antialiased: bool = True, into: np.ndarray | None = None) -> Patches:
    """Resample a block whose first splat is `first_splat` of the scan; `into` (n or more, PATCH_DIM) uint8 is memory
    for its texels.

    A splat without a camera has a patch of its one colour, and so no energy; so has one whose square, once its geometry
    is quantised, reaches behind its camera. Both are flagged, as are those that reach beyond their photo's edge, where
    texels repeat the edge."""
    n = len(block.camera)
    texel = np.empty((n, PATCH_DIM), np.uint8) if into is None else into[:n]
    error, n_probes, n_flagged = 0.0, 0, int((block.camera == NO_CAMERA).sum())
    unseen = np.ones(n, bool)
    for seen in _by_camera(block):
        n_flagged += seen.n_flagged
        if seen.window is None:
            continue
        resample_into(texel, seen.rows, seen.window, seen.homography, antialiased)
        error += float(resampling_error(texel, seen.rows, seen.window, seen.homography, first_splat).sum())
        n_probes += 3 * PROBES * len(seen.rows)
        unseen[seen.rows] = False
    _fill(texel, unseen, block.color)
    return Patches(texel, *measured(texel), error, n_probes, n_flagged)


def patches_again(block: Block, wanted: np.ndarray, antialiased: bool, into: np.ndarray) -> np.ndarray:
    """The texels (m, PATCH_DIM) uint8 of the rows `wanted` (m,), ascending, of a block, in the memory `into` (m or
    more, PATCH_DIM).

    Guarantees: those that `make_patches` made, to the byte, for windows of photographs are those of the whole block."""
    texel = into[: len(wanted)]
    place, unseen = np.full(len(block.camera), -1), np.ones(len(wanted), bool)
    place[wanted] = np.arange(len(wanted))
    for seen in _by_camera(block, place >= 0):
        if seen.window is None:
            continue
        rows = place[seen.rows]
        resample_into(texel, rows, seen.window, seen.homography, antialiased)
        unseen[rows] = False
    _fill(texel, unseen, block.color[wanted])
    return texel


@dataclass(frozen=True)
class _Seen:
    """The splats of a block that one camera shows."""

    rows: np.ndarray  # (m,) of the block, in front of it
    homography: np.ndarray  # (m, 3, 3)
    window: Window | None  # of its photograph; None where no splat is in front
    n_flagged: int  # of all rows; 0 where some are wanted, which nobody counts


def _by_camera(block: Block, wanted: np.ndarray | None = None) -> Iterator[_Seen]:
    """One after the other, so that no more than one window is held; of the rows that are `wanted` (n,) bool, in the
    windows of all."""
    radius = np.broadcast_to(block.radius, len(block.camera))
    for i in np.unique(block.camera[block.camera != NO_CAMERA]):
        rows, camera = np.flatnonzero(block.camera == i), block.cameras[i]
        u, v = block.frame
        h = homographies(camera, block.origin, block.centre[rows], u[rows], v[rows], radius[rows])
        n_flagged = 0 if wanted is not None else int((~is_whole(h, camera.width_px, camera.height_px)).sum())
        in_front = is_in_front(h)
        rows, h = rows[in_front], h[in_front]
        if not len(rows) or (wanted is not None and not wanted[rows].any()):
            yield _Seen(rows, h, None, n_flagged)
            continue
        bounds = whole = window_bounds(project_corners(h), camera.width_px, camera.height_px)
        if wanted is not None and not wanted[rows].all():
            rows, h = rows[wanted[rows]], h[wanted[rows]]
            bounds = window_bounds(project_corners(h), camera.width_px, camera.height_px)
        yield _Seen(
            rows,
            h,
            Window(block.read_window(int(i), *bounds), *bounds[:2], whole if wanted is not None else None),
            n_flagged,
        )


def _fill(texel: np.ndarray, unseen: np.ndarray, color: np.ndarray) -> None:
    """Patches that no photograph shows are of their one colour."""
    texel[unseen] = np.tile(color[unseen], PATCH_SIZE * PATCH_SIZE)


def measured(texel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Averages (n, 3) float32 in 255ths, exact, and energies (n,) float32 of patches (n, PATCH_DIM) uint8."""
    average, energy = np.empty((len(texel), 3), np.float32), np.empty(len(texel), np.float32)
    _measure(texel.reshape(len(texel), -1, 3), average, energy)
    return average, energy


def centred(texel: np.ndarray, average: np.ndarray) -> np.ndarray:
    """What is coded: patches less their average as it is decoded (n, 3) float32, (n, PATCH_DIM) float32 in [-1, 1]."""
    result = np.empty(texel.shape, np.float32)
    _centre(texel, average, result)
    return result


def patch_errors(
    texel: np.ndarray, average: np.ndarray, added: np.ndarray, has: np.ndarray | None = None
) -> tuple[float, float]:
    """Squared error of patches, plain and weighted by the splat's blending weight, summed over all values.

    `texel` (n, PATCH_DIM) uint8 resampled, `average` (n, 3) float32 in 255ths, `added` (m, PATCH_DIM) float32 what the
    atoms add to it, of the rows that `has` (n,) bool names: to the others they add nothing. The sum is clamped to [0, 1]
    as the renderer clamps it.
    """
    row = np.full(len(texel), -1)
    row[slice(None) if has is None else has] = np.arange(len(added))
    return _errors(texel, average, added, row, disc_weights().astype(np.float32))


def texel_errors(texel: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Squared error between patches (n, PATCH_DIM) uint8, plain and weighted as in `patch_errors`, values in [0, 1]."""
    shape = (len(texel), -1, 3)
    return _texel_errors(texel.reshape(shape), other.reshape(shape), disc_weights()[::3])


@kernel()
def _texel_errors(texel, other, weight):
    plain, weighted = 0.0, 0.0
    for i in range(texel.shape[0]):
        for t in range(texel.shape[1]):
            squared = 0
            for k in range(3):
                difference = np.int64(texel[i, t, k]) - np.int64(other[i, t, k])
                squared += difference * difference
            plain += squared
            weighted += weight[t] * squared
    return plain / 65025.0, weighted / 65025.0


@kernel()
def _measure(texel, average, energy):
    n_texels = texel.shape[1]
    for i in range(texel.shape[0]):
        total = 0.0
        for k in range(3):
            first, second = 0, 0
            for t in range(n_texels):
                value = np.int64(texel[i, t, k])
                first += value
                second += value * value
            average[i, k] = first / n_texels
            total += (n_texels * second - first * first) / n_texels
        energy[i] = total / 65025.0


@kernel(fastmath={"contract"})
def _centre(texel, average, result):
    step, width = np.float32(1 / 255), np.uintp(3 * PATCH_SIZE)
    base = np.empty(width, np.float32)  # of a row of texels: a loop over three channels uses no vectors
    for i in range(texel.shape[0]):
        for j in range(width):
            base[j] = average[i, j % 3]
        for y in range(texel.shape[1] // width):
            at = np.uintp(y) * width
            for j in range(width):
                result[i, at + j] = (np.float32(texel[i, at + j]) - base[j]) * step


@kernel(fastmath={"contract", "reassoc", "nsz", "nnan"})
def _errors(texel, average, added, row, weight):
    step, width = np.float32(1 / 255), np.uintp(3 * PATCH_SIZE)
    base, nothing = np.empty(width, np.float32), np.zeros(texel.shape[1], np.float32)
    plain, weighted = 0.0, 0.0
    for i in range(texel.shape[0]):
        for j in range(width):
            base[j] = average[i, j % 3] * step
        more = nothing if row[i] < 0 else added[row[i]]
        patch_plain, patch_weighted = np.float32(0), np.float32(0)
        for y in range(PATCH_SIZE):
            at = np.uintp(y) * width
            for j in range(width):
                decoded = min(max(more[at + j] + base[j], np.float32(0)), np.float32(1))
                error = decoded - np.float32(texel[i, at + j]) * step
                squared = error * error
                patch_plain += squared
                patch_weighted += weight[at + j] * squared
        plain += patch_plain
        weighted += patch_weighted
    return plain, weighted
