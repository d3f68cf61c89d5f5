"""Patches: photographs resampled into the squares of splats.

Paper: HPG 2021, section 3.2: projective, bilinear, the whole square and not only the disc, in sRGB. Texel (row,
column) of a patch lies at x = (column + 0.5) / 16 - 1, y = (row + 0.5) / 16 - 1 of its square. Where a texel covers
more than a photo pixel, it is the mean of as many bilinear lookups as it covers pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.execution.compiled import kernel, part
from pipeline.numerics.hashing import BY_SEED, STEP, mixed
from storage.packed.schema import PATCH_SIZE

PATCH_DIM = 3 * PATCH_SIZE * PATCH_SIZE
MOST_LOOKUPS = 64  # a texel and axis; more would mean a splat of 2,000 photo pixels
PROBES = 4  # random points of the disc that the resampling error is measured at


@dataclass(frozen=True)
class Window:
    """A part of a photograph: pixels[y - top, x - left] is its pixel (x, y).

    As a part of a `whole` window lookups in it round as in that one, so that patches are the same to the byte."""

    pixels: np.ndarray  # (h, w, 3) uint8
    left: int
    top: int
    whole: tuple[int, int, int, int] | None = None  # left, top, right, bottom

    @cached_property
    def padded(self) -> np.ndarray:
        """The pixels as lookups want them; made once for all that look at the window."""
        return _padded(self.pixels)

    @property
    def place(self) -> tuple[int, int, float, float, int, int]:
        """Left and top that lookups count from, the last column and row from there, and where the pixels begin."""
        right, bottom = self.left + self.pixels.shape[1], self.top + self.pixels.shape[0]
        left, top, right, bottom = self.whole or (self.left, self.top, right, bottom)
        return left, top, right - left - 1.0, bottom - top - 1.0, self.left - left, self.top - top


def window_bounds(corners: np.ndarray, width_px: int, height_px: int) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of the pixels that bilinear lookups between `corners` (n, 4, 2) can touch."""
    low = np.floor(corners.min(axis=(0, 1)) - 1.5)
    high = np.ceil(corners.max(axis=(0, 1)) + 1.5)
    left, top = (int(np.clip(x, 0, size - 1)) for x, size in zip(low, (width_px, height_px)))
    right, bottom = (int(np.clip(x, 1, size)) for x, size in zip(high, (width_px, height_px)))
    return left, top, max(right, left + 1), max(bottom, top + 1)


def lookups_a_texel(homography: np.ndarray) -> np.ndarray:
    """How many photo pixels a texel covers along x and along y, rounded up, of splats with `homography` (n, 3, 3): (n,
    2)."""
    return np.array([_lookups_a_texel(h) for h in homography], np.int64).reshape(-1, 2)


def resample_patches(window: Window, homography: np.ndarray, antialiased: bool = True) -> np.ndarray:
    """Patches (n, PATCH_DIM) uint8, flattened (row, column, rgb), of the splats with `homography` (n, 3, 3).

    Not `antialiased`, a texel is one lookup however many pixels it covers. The whole square must lie in front of the
    camera (`is_in_front`). Lookups outside the photo take its edge.
    """
    patches = np.empty((len(homography), PATCH_DIM), np.uint8)
    resample_into(patches, np.arange(len(homography)), window, homography, antialiased)
    return patches


def resample_into(
    patches: np.ndarray, rows: np.ndarray, window: Window, homography: np.ndarray, antialiased: bool
) -> None:
    """As `resample_patches`, into these rows (m,) of patches (n, PATCH_DIM) uint8."""
    shaped = patches.reshape(-1, PATCH_SIZE, PATCH_SIZE, 3)
    _resample(window.padded, *window.place, homography, shaped, rows, antialiased)


def resampling_error(
    patches: np.ndarray, rows: np.ndarray, window: Window, homography: np.ndarray, first_splat: int
) -> np.ndarray:
    """Sum of squared differences (m,) of photo lookups and patch lookups at PROBES random points of the discs of these
    rows.

    Values in [0, 1], three channels a point. `first_splat` is the global index of row 0, which the points go by.
    """
    error = np.empty(len(homography))
    shaped = patches.reshape(-1, PATCH_SIZE, PATCH_SIZE, 3)
    assert window.whole is None
    _probe(window.padded, window.left, window.top, homography, shaped, rows, first_splat, error)
    return error


def _padded(pixels: np.ndarray) -> np.ndarray:
    """Pixels (h, w, 3) uint8 as (h + 1, w + 1) uint32, red in the lowest byte, edges repeated: a lookup needs no test
    of its right and lower neighbours, and a pixel is one load."""
    padded = np.empty((pixels.shape[0] + 1, pixels.shape[1] + 1), np.uint32)
    _pack(pixels, padded)
    return padded


@kernel()
def _pack(pixels, padded):
    height, width = pixels.shape[:2]
    for y in range(height + 1):
        row = min(y, height - 1)
        for x in range(width):
            red, green, blue = pixels[row, x, 0], pixels[row, x, 1], pixels[row, x, 2]
            padded[y, x] = np.uint32(red) | np.uint32(green) << np.uint32(8) | np.uint32(blue) << np.uint32(16)
        padded[y, width] = padded[y, width - 1]


def disc_weights() -> np.ndarray:
    """The blending weight max(0, 1 - d^2) of each texel, repeated for its three channels, (PATCH_DIM,) float64."""
    at = (np.arange(PATCH_SIZE) + 0.5) * 2 / PATCH_SIZE - 1
    weight = np.maximum(0, 1 - at[:, None] ** 2 - at[None, :] ** 2)
    return np.repeat(weight.ravel(), 3)


# The loops over a row's texels are apart, and write to arrays of their own, so that the compiler may use vectors: a
# kernel that does all for one texel after the other takes twice as long.


@part(error_model="numpy", fastmath={"contract"})
def _project_row(h, y, within, left, top, last_x, last_y, first, stride, place, right, down):
    """Where the photo is looked up at height y of the square, `within` (0 to 1) of each texel: the pixel's place in the
    array, which begins `first` pixels after (left, top), clamped to the pixels there are, and the shares of its right
    and lower neighbours."""
    a, b, c = h[0, 1] * y + h[0, 2], h[1, 1] * y + h[1, 2], h[2, 1] * y + h[2, 2]
    da, db, dc = h[0, 0], h[1, 0], h[2, 0]
    for i in range(PATCH_SIZE):
        x = (i + within) * (2.0 / PATCH_SIZE) - 1.0
        w = 1.0 / (dc * x + c)
        at_x = min(max((da * x + a) * w - 0.5 - left, 0.0), last_x)
        at_y = min(max((db * x + b) * w - 0.5 - top, 0.0), last_y)
        column, row = np.int32(at_x), np.int32(at_y)
        place[i] = row * stride + column - first
        right[i], down[i] = np.float32(at_x - column), np.float32(at_y - row)


@part()
def _fetch_row(flat, stride, place, corner):
    """The four pixels around each place. Unsigned indices spare numba's test for negative ones."""
    for i in range(PATCH_SIZE):
        above = np.uint64(place[i])
        below = above + np.uint64(stride)
        corner[0, i], corner[1, i] = flat[above], flat[above + np.uint64(1)]
        corner[2, i], corner[3, i] = flat[below], flat[below + np.uint64(1)]


@part(error_model="numpy", fastmath={"contract"})
def _add_row(corner, right, down, total):
    """Add the bilinear lookups to total (3, PATCH_SIZE)."""
    for k in range(3):
        for i in range(PATCH_SIZE):
            total[k, i] += _between(
                corner[0, i], corner[1, i], corner[2, i], corner[3, i], right[i], down[i], np.uint32(8 * k)
            )


@part(error_model="numpy", fastmath={"contract"})
def _between(p, q, r, s, right, down, shift):
    """One channel of the bilinear lookup between the pixels p, q above and r, s below."""
    byte = np.uint32(255)
    a, b = np.float32(np.int32((p >> shift) & byte)), np.float32(np.int32((q >> shift) & byte))
    c, d = np.float32(np.int32((r >> shift) & byte)), np.float32(np.int32((s >> shift) & byte))
    upper, lower = a + right * (b - a), c + right * (d - c)
    return upper + down * (lower - upper)


@part(error_model="numpy", fastmath={"contract"})
def _write_row(total, share, byte, texels):
    for k in range(3):
        for i in range(PATCH_SIZE):
            byte[k, i] = np.uint8(np.int32(total[k, i] * share + np.float32(0.5)))
    for i in range(PATCH_SIZE):
        texels[i, 0], texels[i, 1], texels[i, 2] = byte[0, i], byte[1, i], byte[2, i]


@kernel()
def _lookups_a_texel(h):
    """How many photo pixels a texel covers along x and y, at the square's worst corner; at least 1."""
    step = 2.0 / PATCH_SIZE
    most_x, most_y = 1.0, 1.0
    for sx in (-1.0, 1.0):
        for sy in (-1.0, 1.0):
            w = h[2, 0] * sx + h[2, 1] * sy + h[2, 2]
            px = (h[0, 0] * sx + h[0, 1] * sy + h[0, 2]) / w
            py = (h[1, 0] * sx + h[1, 1] * sy + h[1, 2]) / w
            most_x = max(most_x, step * np.hypot(h[0, 0] - px * h[2, 0], h[1, 0] - py * h[2, 0]) / w)
            most_y = max(most_y, step * np.hypot(h[0, 1] - px * h[2, 1], h[1, 1] - py * h[2, 1]) / w)
    return min(int(np.ceil(most_x - 1e-9)), MOST_LOOKUPS), min(int(np.ceil(most_y - 1e-9)), MOST_LOOKUPS)


@kernel(fastmath={"contract"})
def _resample(pixels, left, top, last_x, last_y, right_by, down_by, homography, patches, rows, antialiased):
    flat, stride = pixels.reshape(-1), np.int32(pixels.shape[1])
    first = np.int32(down_by) * stride + np.int32(right_by)
    place, corner = np.empty(PATCH_SIZE, np.int32), np.empty((4, PATCH_SIZE), np.uint32)
    right, down = np.empty(PATCH_SIZE, np.float32), np.empty(PATCH_SIZE, np.float32)
    total, byte = np.empty((3, PATCH_SIZE), np.float32), np.empty((3, PATCH_SIZE), np.uint8)
    for i in range(homography.shape[0]):
        n_x, n_y = 1, 1
        if antialiased:
            n_x, n_y = _lookups_a_texel(homography[i])
        for row in range(PATCH_SIZE):
            total[:] = 0
            for j in range(n_y):
                y = (row + (j + 0.5) / n_y) * (2.0 / PATCH_SIZE) - 1.0
                for k in range(n_x):
                    _project_row(
                        homography[i], y, (k + 0.5) / n_x, left, top, last_x, last_y, first, stride, place, right, down
                    )
                    _fetch_row(flat, stride, place, corner)
                    _add_row(corner, right, down, total)
            _write_row(total, np.float32(1.0 / (n_x * n_y)), byte, patches[rows[i], row])


@kernel()
def _uniform(state):
    """The next state of a splitmix64 stream and a number in [0, 1) (Steele et al. 2014)."""
    state = state + STEP
    return state, np.float64(mixed(state) >> np.uint64(11)) / 9007199254740992.0


@kernel()
def _probe(pixels, left, top, homography, patches, rows, first_splat, error):
    last_x, last_y = pixels.shape[1] - 2.0, pixels.shape[0] - 2.0
    for i in range(homography.shape[0]):
        h = homography[i]
        state = np.uint64(first_splat + rows[i]) * BY_SEED
        error[i] = 0.0
        for _ in range(PROBES):
            state, a = _uniform(state)
            state, b = _uniform(state)
            x, y = np.sqrt(a) * np.cos(2 * np.pi * b), np.sqrt(a) * np.sin(2 * np.pi * b)
            w = 1.0 / (h[2, 0] * x + h[2, 1] * y + h[2, 2])
            px = min(max((h[0, 0] * x + h[0, 1] * y + h[0, 2]) * w - 0.5 - left, 0.0), last_x)
            py = min(max((h[1, 0] * x + h[1, 1] * y + h[1, 2]) * w - 0.5 - top, 0.0), last_y)
            column, row = np.int64(px), np.int64(py)
            right, down = np.float32(px - column), np.float32(py - row)
            for k in range(3):
                photo = _between(
                    pixels[row, column],
                    pixels[row, column + 1],
                    pixels[row + 1, column],
                    pixels[row + 1, column + 1],
                    right,
                    down,
                    np.uint32(8 * k),
                )
                patch = _texel_between(
                    patches[rows[i]], (x + 1) * PATCH_SIZE / 2 - 0.5, (y + 1) * PATCH_SIZE / 2 - 0.5, k
                )
                error[i] += ((photo - patch) / 255.0) ** 2


@kernel()
def _texel_between(patch, column, row, channel):
    """The bilinear lookup in a patch (s, s, 3), edge clamped."""
    last = PATCH_SIZE - 1
    column, row = min(max(column, 0.0), float(last)), min(max(row, 0.0), float(last))
    c0, r0 = int(column), int(row)
    c1, r1 = min(c0 + 1, last), min(r0 + 1, last)
    f, g = column - c0, row - r0
    upper = (1 - f) * patch[r0, c0, channel] + f * patch[r0, c1, channel]
    lower = (1 - f) * patch[r1, c0, channel] + f * patch[r1, c1, channel]
    return (1 - g) * upper + g * lower
