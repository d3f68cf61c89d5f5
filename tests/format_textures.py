"""What splats around a splat show on its square, by docs/FORMAT.md alone ("Continued textures"); nothing of the product."""

from __future__ import annotations

import math

import numpy as np

F = np.float32
SEEN = [(i + 0.5) / 4 - 1 for i in range(8)]


def power(steps: int) -> float:
    return round(65536 * 2.0 ** (steps % 16 / 16)) / 65536 * 2.0 ** (steps // 16)


def rows_of(turn: list[int], w: int) -> list[list[float]]:
    x, y, z = (float(value) for value in turn)
    s = x * x + y * y + z * z + w * w
    rows = [
        [s - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
        [2 * (x * y - z * w), s - 2 * (x * x + z * z), 2 * (y * z + x * w)],
        [2 * (x * z + y * w), 2 * (y * z - x * w), s - 2 * (x * x + y * y)],
    ]
    return [[value / s for value in row] for row in rows]


def normal_of(row: dict, boxes: bool, a: int, b: int, u: int, v: int) -> tuple[int, int, int]:
    """The normal in whole numbers, of a splat `u` and `v` half cells from the middle."""
    steps = 127
    if not boxes:
        steps, (s0, s1, s2, s3) = 175 - 8 * row["normal_grid"][0], row["normal_slope"]
        b += row["normal_low"][1] + ((s2 * u + s3 * v) >> 8) + ((row["normal_lean"][0] * a) >> 6)
        a += row["normal_low"][0] + ((s0 * u + s1 * v) >> 8)
        a, b = (min(max(x, -2 * steps), 2 * steps) for x in (a, b))
        if abs(a) > steps:
            a, b = 2 * steps * (1 if a > 0 else -1) - a, -b
        if abs(b) > steps:
            a, b = -a, 2 * steps * (1 if b > 0 else -1) - b
    else:
        a, b = a - 127, b - 127
    c = steps - abs(a) - abs(b)
    if c >= 0:
        return a, b, c
    return (steps - abs(b)) * (1 if a >= 0 else -1), (steps - abs(a)) * (1 if b >= 0 else -1), c


class Atoms:
    """A file's dictionary: texels (k, s, s, 3) of the finest level, scales (k,), weights (r, w)."""

    def __init__(self, texels: np.ndarray, scale: np.ndarray, levels: np.ndarray) -> None:
        k, factor = len(texels), texels.shape[1] // 8
        eight = np.round(texels.reshape(k, 8, factor, 8, factor, 3).mean(axis=(2, 4))).astype(int)
        grey = (2 * eight.sum(axis=3) + 3) // 6
        turns = []
        for turn in range(8):
            x = grey[:, :, ::-1] if turn & 1 else grey
            x = x[:, ::-1] if turn & 2 else x
            turns.append(x.transpose(0, 2, 1) if turn & 4 else x)
        self.turned = np.stack(turns, axis=1).reshape(k, 8, 64)
        self.least = (0.4 / 3 * (eight * eight).sum(axis=(1, 2, 3)) + 1).astype(F)
        self.worth, self.levels = 510 * scale.astype(float), levels.astype(float)


class Square:
    """Of a splat of a chunk: where it lies, and what neighbours show there. `normal` are whole numbers."""

    def __init__(
        self, header: dict, row: dict, axes: list[int], boxes: bool, n_sizes: int, splat: dict, normal
    ) -> None:
        if boxes:
            along = [[float(a == k) for k in range(3)] for a in axes]
            side = max(
                float(np.uint32(s).view(F)) / 2.0**b for s, b in zip(row["box_size"], row["box_bits"], strict=True)
            )
            side = side if side > 0 else 1.0
        else:
            along, side = rows_of(row["frame_turn"], 117), float(np.uint32(row["frame_step"][0] << 16).view(F))
        steps = 128
        if header["size_bits"]:
            (low, high), most = row["size_scale"], max(n_sizes - 1, 1)
            steps = (2 * (low * most + (high - low) * splat.get("size", 0)) + most) // (2 * most)
        self.radius = min(max(header["radius"] * power(steps - 128) / side, 2.0**-40), 2.0**40)
        n, (up, ahead) = [float(x) for x in normal], (header["up"], header["ahead"])
        square, rises = n[0] * n[0] + n[1] * n[1] + n[2] * n[2], n[0] * up[0] + n[1] * up[1] + n[2] * up[2]
        level = 100 * rises * rises > 81 * square * (up[0] * up[0] + up[1] * up[1] + up[2] * up[2])
        r = ahead if level else up
        u = _cross(r, n)
        by = 1 / (math.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]) + 1e-30)
        u = [x * by for x in u]
        by = 1 / (math.sqrt(square) + 1e-30)
        v = [x * by for x in _cross(n, u)]
        self.u, self.v = ([_dot(axis, a) for a in along] for axis in (u, v))
        self.texels: np.ndarray | None = None
        self.shown = np.zeros(64, F)

    def see(self, place: list[float], near: list[Square]) -> None:
        self.place = place
        self.found: list[float | None] = []
        views = []
        for o in near:
            d, by = [a - b for a, b in zip(place, o.place, strict=True)], 1 / o.radius
            views.append((o, F(_dot(d, o.u) * by), F(_dot(d, o.v) * by), F(self.radius * by)))
        for i in range(64):
            best, value = F(2), None
            for o, x0, y0, side in views:
                x, y = x0 + F(SEEN[i % 8]) * side, y0 + F(SEEN[i // 8]) * side
                if x * x + y * y < best and abs(x) < F(1.1) and abs(y) < F(1.1):
                    best, value = x * x + y * y, _looked_up(o.shown, x, y)
            self.found.append(value)

    def light(self, header: dict, row: dict, color: list[int]) -> float:
        if not header["color_step"]:
            return 2 * sum(color) / 3
        extent = [power(s - 96) / 2.0 ** max(0, -((header["color_step"] - s) // 16)) for s in row["color_size"]]
        turn = [r[0] for r in rows_of(row["color_turn"], 306)]
        least = [low / 32 + e / 2 for low, e in zip(row["color_low"], extent, strict=True)]
        light = 2 * 0.57735 * _dot(least, turn)
        for e, r, cell in zip(extent, turn, color, strict=True):
            light += 2 * 0.57735 * (e * r) * cell
        return light

    def differ(self, light: float) -> int:
        """Returns the contrast."""
        self.shown[:] = light
        self.looked = np.array([value is not None for value in self.found])
        self.differs = np.array([0 if v is None else _held(float(v) - light) for v in self.found])
        n, squares = int(self.looked.sum()), float((self.differs**2).sum())
        self.quarter = max(4 * n - 1, 0) // 64
        return min(33, 1 + _octaves(squares / n)) if n else 0

    def look(self, atoms: Atoms) -> np.ndarray | None:
        """The masses (k, 8)."""
        if not self.looked.any():
            return None
        self.product = (4 * atoms.turned @ self.differs).astype(F)
        self.size = (4 * (atoms.turned**2 @ self.looked)).astype(F) + atoms.least[:, None]
        share = self.product * self.product / self.size
        best = share.max()
        if best <= 0:
            return None
        less = F(1.03) - share * (F(1) / best)
        return F(1) / (less * less)

    def met(self, atoms: Atoms, rank: int, atom: int, turn: int, low: int) -> int:
        if atoms.worth[atom] <= 0:
            return 0
        wanted = float(self.product[atom, turn]) / float(self.size[atom, turn]) / atoms.worth[atom]
        level = int(np.argmin(np.abs(atoms.levels[rank] - wanted)))
        return 1 + (min(rank, 3) * 4 + self.quarter) * 16 + (level >> low)

    def add(self, atoms: Atoms, rank: int, atom: int, turn: int, weight: int) -> None:
        shows = atoms.worth[atom] * atoms.levels[rank, weight] * atoms.turned[atom, turn]
        self.shown += shows.astype(F)
        self.differs = np.where(self.looked, np.floor(np.clip(self.differs - shows, -255, 255) + 0.5), 0)


def tree_of(masses: np.ndarray | None, bits: int) -> list:
    """Of each way of a tree of atoms the masses below."""
    if masses is None:
        return []
    nodes = [F(0)] * (2 << bits)
    for atom, row in enumerate(masses):
        for mass in row:
            nodes[(1 << bits) + atom] += mass
    for node in range((1 << bits) - 1, 0, -1):
        nodes[node] = nodes[2 * node] + nodes[2 * node + 1]
    return nodes


def turns_of(masses: np.ndarray) -> list:
    """The same of the eight turns of an atom, sums one after the other."""
    nodes = [F(0)] * 16
    for k in range(1, 4):
        for node in range(1 << k, 2 << k):
            begin = (node << (3 - k)) - 8
            for turn in range(begin, begin + (1 << (3 - k))):
                nodes[node] += masses[turn]
    return nodes


def _looked_up(shown: np.ndarray, x: np.float32, y: np.float32) -> np.float32:
    x, y = (x + F(1)) * F(4) - F(0.5), (y + F(1)) * F(4) - F(0.5)
    column, row = math.floor(x), math.floor(y)
    fx, fy = x - F(column), y - F(row)
    left, right, top, bottom = max(column, 0), min(column + 1, 7), max(row, 0), min(row + 1, 7)
    upper, lower = (shown[8 * r + left] + (shown[8 * r + right] - shown[8 * r + left]) * fx for r in (top, bottom))
    return upper + (lower - upper) * fy


def _held(x: float) -> float:
    return math.floor(min(max(x, -255.0), 255.0) + 0.5)


def _octaves(x: float) -> int:
    whole = int(x)
    n = whole.bit_length()
    return 2 * n + (whole >> (n - 2) & 1 if n > 1 else 0)


def _cross(a, b) -> list[float]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _dot(a, b) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
