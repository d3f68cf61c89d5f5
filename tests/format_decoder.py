"""A decoder and a renderer of packed files made from docs/FORMAT.md alone: numpy, zarr and Pillow, nothing of the
product.

What this file needs and the page lacks is a mistake of the page. Slow: one splat after the other, in float64.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import zarr
from numcodecs.zstd import Zstd
from PIL import Image
from zarr.storage import ZipStore

from tests.format_runs import Run, runs_of_group

NEAR_IN_RADII, NUDGE, LEAST_WEIGHT, SMALLEST_PX = 0.01, 1e-5, 1 / 1024, 1e-3


def turned(quaternion: list, p: np.ndarray) -> np.ndarray:
    q = np.array(quaternion) / np.linalg.norm(quaternion)
    return p + 2 * np.cross(q[:3], np.cross(q[:3], p) + q[3] * p)


@dataclass(frozen=True)
class View:
    """A camera as in the header, for a picture."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    rotation: np.ndarray  # (3, 3)
    centre: np.ndarray  # (3,)


@dataclass(frozen=True)
class Decoded:
    """One splat: all lengths in the header's unit."""

    position: np.ndarray  # (3,) absolute
    radius: float
    frame: np.ndarray  # (3, 3) u, v, normal as rows
    color: np.ndarray  # (3,) sRGB
    atoms: list[tuple[int, int, float]]  # atom, turn, what its texels are times
    clipline: np.ndarray | None  # a, b, c
    station: int  # the map that it is textured from, -1 for none
    axes: np.ndarray | None  # (3, 3) half axes of an ellipsoid as rows


@dataclass(frozen=True)
class Map:
    """What a station saw."""

    centre: np.ndarray
    height: int
    nearest: float
    step: float
    color: np.ndarray  # (h, 6 h, 3)
    codes: np.ndarray  # (h, 6 h)

    def place(self, x: float, y: float, z: float) -> tuple[int, float, float]:
        """Chart (0 bottom, 1 top, 2 band), column and row of a direction."""
        h, rho = self.height, np.hypot(x, y)
        if abs(z) <= rho:
            turn = np.arctan2(y, x) / (2 * np.pi)
            return 2, h * (4 * (turn - np.floor(turn)) + 2), h * (2 / np.pi * np.arctan2(z, rho) + 0.5)
        r = 2 / np.pi * np.arctan2(rho, abs(z)) / max(rho, 1e-30)
        return int(z > 0), h * (x * r + 0.5 + (z > 0)), h * (y * r + 0.5)

    def taps(self, chart: int, column: float, row: float) -> list[tuple[int, int, float]]:
        """Row, column and weight of the four texels about a place."""
        h, column, row = self.height, column - 0.5, row - 0.5
        found = []
        for dy in (0, 1):
            for dx in (0, 1):
                c, r = int(np.floor(column)) + dx, int(np.floor(row)) + dy
                weight = (1 - abs(column - c)) * (1 - abs(row - r))
                c = 2 * h + (c - 2 * h) % (4 * h) if chart == 2 else min(max(c, chart * h), chart * h + h - 1)
                found.append((min(max(r, 0), h - 1), c, weight))
        return found

    def texel(self, f: np.ndarray, level: int = 0) -> tuple[int, int]:
        """Row and column of the texel of a level in which a direction lies."""
        chart, column, row = self.place(*f)
        first, h = (chart * self.height) >> level, self.height >> level
        width = 4 * h if chart == 2 else h
        column, row = int(np.floor(column / 2**level)) - first, int(np.floor(row / 2**level))
        return min(row, h - 1), first + (column % width if chart == 2 else min(column, width - 1))

    def code(self, f: np.ndarray) -> float:
        return float(1 + np.log(np.linalg.norm(f) / self.nearest) / self.step)

    def shown(self, f: np.ndarray, slack: float, level: int) -> tuple[str, list]:
        """Whether it shows a fragment at `f` from the station, hides it, or leaves it free, and the taps that fit."""
        code, off = self.code(f), slack / np.linalg.norm(f) / self.step
        if level > 0:
            there = self.codes[self.texel(f)]
            if there > 0 and abs(there - code) <= off:
                return "shown", []
            return ("hidden" if 0 < there < code else "free"), []
        taps = [tap for tap in self.taps(*self.place(*f)) if self.codes[tap[:2]] > 0]
        fit = [tap for tap in taps if abs(self.codes[tap[:2]] - code) <= off]
        before = sum(w for r, c, w in taps if self.codes[r, c] < code - off)
        if sum(w for *_, w in fit) >= 0.25:
            return "shown", fit
        return ("hidden" if before >= 0.25 else "free"), []

    def moved(self, f: np.ndarray, fit: list, eye: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Along the ray from the eye, to where the surface of the taps that fit lies."""
        ray = (f - eye) / np.linalg.norm(f - eye)
        if abs(ray @ normal) < 0.3:
            return f
        there = sum(w * self.codes[r, c] for r, c, w in fit) / sum(w for *_, w in fit)
        return f + ray * (f @ normal) * (np.exp((there - self.code(f)) * self.step) - 1) / (ray @ normal)

    def look_up(self, f: np.ndarray, fit: list, level: int) -> np.ndarray:
        """(3,) sRGB, 255 is white."""
        if level > 0:
            (row, column), n = self.texel(f, level), 2**level
            block = slice(row * n, row * n + n), slice(column * n, column * n + n)
            return self.color[block][self.codes[block] > 0].mean(axis=0)
        return sum(w * self.color[row, column] for row, column, w in fit) / sum(w for *_, w in fit)


@dataclass(frozen=True)
class Fragments:
    pixel: np.ndarray  # (m,) index in the flattened picture
    place: np.ndarray  # (m, 2) on the splat's square
    d2: np.ndarray
    z: np.ndarray
    pushed_z: np.ndarray
    hides: np.ndarray
    area_px: float | None
    ball: np.ndarray | None = None  # (m, 3) of an ellipsoid, in its half axes


class Packed:
    """An opened file; `splat(i)` decodes one splat."""

    def __init__(self, path: Path, dictionaries: Path | None = None) -> None:
        with ZipStore(path, mode="r") as store:
            root = zarr.open_group(store, mode="r")
            self.header = dict(root.attrs)
            self.arrays = {name: np.asarray(root[name][:]) for name in root.array_keys()}
        if "shipped" in self.header:
            self.arrays |= self.shipped(dictionaries / f"{self.header['shipped'][:16]}.atoms")
        several = ("splats", "run_codes", "colors", "codes", "cliplines", "ellipsoids")
        several = [name for name in several if name in self.arrays]  # in the order of the page
        self.rows_of = dict(zip(several, self.arrays["group_rows"].T)) if several else {}
        self.runs: dict[int, list[Run]] = {}  # by group
        self.batches = self.header["batches"]
        counts = self.arrays["batch_count"].astype(int)
        self.batch = np.repeat(np.tile(np.arange(len(self.batches)), len(counts)), counts.ravel())

    def __len__(self) -> int:
        return self.header["n_splats"]

    def before(self, i: int, amount: str) -> int:
        """The sum of `amount` over the splats that come before in the group's streams: batch by batch, then by
        number."""
        first = i // 8192 * 8192
        of = np.array([int(batch.get(amount, 0)) for batch in self.batches])
        batch = self.batch[first : first + 8192]
        earlier = (batch < self.batch[i]) | ((batch == self.batch[i]) & (np.arange(len(batch)) < i - first))
        return int(of[batch[earlier]].sum())

    def field(self, stream: str, group: int, bit: int, width: int) -> int:
        two = self.arrays[stream][group, bit // 32 : bit // 32 + 2].astype("<u4").tobytes()
        return int.from_bytes(two, "little") >> bit % 32 & (1 << width) - 1

    def run_cell(self, i: int) -> tuple[np.ndarray, tuple[int, int]]:
        """Position against the origin and octahedral normal of a splat of runs."""
        a, first, group = self.arrays, i // 128 * 128, i // 8192
        cell = i
        if "run_batch" in a:
            cell = first + int(np.argsort(a["run_batch"][first : first + 128], kind="stable")[i - first])
        if group not in self.runs:
            coded = a["run_codes"][group, : self.rows_of["run_codes"][group]].tobytes()
            self.runs[group] = runs_of_group(coded, min(8192, len(self) - 8192 * group))
        cell -= 8192 * group
        end = np.cumsum([1 + len(run.steps) for run in self.runs[group]])
        run = self.runs[group][int(np.searchsorted(end, cell, side="right"))]
        c, r, s = run.column, run.row, run.slice_
        (x, y), k = run.normal, 0
        for turn, entry in run.steps[: cell - int(end[end <= cell].max(initial=0))]:
            k, q = (k + turn) % 6, (r + s) % 2
            c += (1, q, q - 1, -1, q - 1, q)[k]
            r += (0, 1, 1, 0, -1, -1)[k]
            x, y = (p + d for p, d in zip((x, y), a["run_codebook"][entry].tolist()))
            if abs(x) > 127:
                x, y = int(np.sign(x)) * 254 - x, -y
            if abs(y) > 127:
                x, y = -x, int(np.sign(y)) * 254 - y
        size, turn = (self.header["runs"][name] for name in ("cell", "turn"))
        pitch = np.array([size / 2, size * (np.sqrt(3) / 2) / 3, size * np.sqrt(2 / 3)], np.float32)
        p = np.array([2 * c + (r + s) % 2, 3 * r + s % 2, s], np.float32) * pitch
        products = np.array(turn, np.float32).reshape(3, 3) * p
        return ((products[:, 0] + products[:, 1]) + products[:, 2]).astype(float), (x, y)

    def high(self, n: int, bits: int) -> int:
        """How many bits of the numbers of n splats are in unary."""
        h = 0
        while 2**h < n:
            h += 1
        h = min(h, bits - 16)
        return h if h * n > n + 2**h else 0

    def number(self, i: int) -> int:
        """The number of a splat of quadrics."""
        chunk, left, at = i // 128, i % 128, 0
        bits, counts = self.arrays["frame_bits"].astype(int).tolist(), self.arrays["batch_count"].astype(int).tolist()
        for other in range(chunk // 64 * 64, chunk + 1):
            for n in counts[other]:
                h = self.high(n, bits[other])
                vector = n + 2**h if h else 0
                low = bits[other] - h
                if other == chunk and left < n:
                    place, ones = -1, -1
                    while h and ones < left:
                        place += 1
                        ones += self.field("splats", i // 8192, at + place, 1)
                    at += vector + left * low
                    first = (
                        self.field("splats", i // 8192, at, 16)
                        | self.field("splats", i // 8192, at + 16, low - 16) << 16
                    )
                    return ((place - left) << low if h else 0) + first
                left -= n if other == chunk else 0
                at += vector + n * low
        raise AssertionError(i)

    def quadric_cell(self, i: int) -> tuple[np.ndarray, tuple[int, int], int]:
        """Position against the origin, octahedral normal and the steps of its map, of a splat of quadrics."""
        of = {
            name: np.array(values[i // 128]).astype(float)
            for name, values in self.arrays.items()
            if name.startswith(("frame_", "normal_")) and name != "frame_step"
        }
        number, digits = self.number(i) // self.size_values(i // 128), []
        for many in (*(of["normal_cells"] + 1), *of["frame_cells"]):
            digits.append(number % int(many))
            number //= int(many)
        x, y = (2 * d + 1 - n for d, n in zip(digits[2:], of["frame_cells"]))
        power = 1
        while power <= of["frame_cells"].max():
            power *= 2
        rise = of["frame_curve"] @ [x * x, x * y, y * y] / (128 * power)
        step = np.array([0, self.arrays["frame_step"][i // 128]], "<u2").view("<f4")[0].astype(float)
        p = turned([*of["frame_turn"], 117], np.array([digits[2] + 0.5, digits[3] + 0.5, number + 0.5 + rise]) * step)
        slope = of["normal_slope"].reshape(2, 2) @ [x, y] // 256 + [0, of["normal_lean"] * digits[0] // 64]
        s = 175 - 8 * int(of["normal_grid"])
        a, b = np.clip(of["normal_low"] + digits[:2] + slope, -2 * s, 2 * s).astype(int).tolist()
        if abs(a) > s:
            a, b = int(np.sign(a)) * 2 * s - a, -b
        if abs(b) > s:
            a, b = -a, int(np.sign(b)) * 2 * s - b
        low, high = (self.arrays[f"group_{name}"][i // 8192] for name in ("low", "high"))
        side, unit = float((high - low).max()), 2.0**-115
        while side >= 2.0**16 * unit:
            unit *= 2
        return low.astype(float) + of["frame_origin"] * unit + p, (a, b), s

    def position(self, i: int) -> np.ndarray:
        if self.header.get("geometry") == "quadrics":
            return np.array(self.header["origin"]) + self.quadric_cell(i)[0]
        if self.header.get("geometry") == "runs":
            return np.array(self.header["origin"]) + self.run_cell(i)[0]
        number = int.from_bytes(self.arrays["position"][i].tobytes(), "little")
        bits = self.arrays["box_bits"][i // 128].astype(int)
        cell = np.array(
            [number % 2 ** bits[0], (number >> int(bits[0])) % 2 ** bits[1], number >> int(bits[0] + bits[1])]
        )
        low, size = (self.arrays[name][i // 128].astype(float) for name in ("box_low", "box_size"))
        return np.array(self.header["origin"]) + (low + (cell + 0.5) * size / 2.0**bits)

    def frame(self, i: int) -> np.ndarray:
        cell = {"runs": self.run_cell, "quadrics": self.quadric_cell}.get(self.header.get("geometry"))
        _, (a, b), *steps = cell(i) if cell else (0, self.arrays["normal"][i].tolist())
        s = steps[0] if steps else 127
        c = s - abs(a) - abs(b)
        sign = (1 if a >= 0 else -1), (1 if b >= 0 else -1)
        p = np.array([a, b, c] if c >= 0 else [sign[0] * (s - abs(b)), sign[1] * (s - abs(a)), c])
        up, ahead = np.array(self.header["up"]), np.array(self.header["ahead"])
        reference = ahead if 100 * int(p @ up) ** 2 > 81 * int(p @ p) * int(up @ up) else up
        normal = p / np.linalg.norm(p)
        u = np.cross(reference, normal)
        u = u / np.linalg.norm(u)
        return np.array([u, np.cross(normal, u), normal])

    def radius(self, i: int) -> float:
        bits, (chunk, place) = self.header["size_bits"], divmod(i, 128)
        if bits == 0:
            return self.header["radius"]
        low, high = self.arrays["size_scale"][chunk].tolist()
        if self.header.get("geometry") == "quadrics":
            n = self.size_values(chunk)
            q = self.number(i) % n
        else:
            n = 2**bits
            q = int.from_bytes(self.arrays["sizes"][chunk].astype("<u4").tobytes(), "little") >> place * bits & n - 1
        return self.header["radius"] * 2.0 ** ((low + ((high - low) * q / (n - 1) if n > 1 else 0)) / 16 - 8)

    def size_values(self, chunk: int) -> int:
        """How many values sizes have over quadrics."""
        if self.header["size_bits"] == 0:
            return 1
        low, high = self.arrays["size_scale"][chunk].tolist()
        return min(16, 1 + (8 * (high - low) + 14) // 15)

    def color(self, i: int) -> np.ndarray:
        step, chunk = self.header["color_step"], i // 128
        if step == 0:
            return self.arrays["color"][i] / 255
        size = self.arrays["color_size"][chunk].astype(int)
        bits = np.maximum(0, np.ceil((size - step) / 16).astype(int)).tolist()
        before = np.maximum(0, np.ceil((self.arrays["color_size"][chunk // 64 * 64 : chunk].astype(int) - step) / 16))
        first_bit = 128 * int(before.sum()) + i % 128 * sum(bits)
        number = self.field("colors", i // 8192, first_bit, sum(bits)) if sum(bits) else 0
        cell = np.array([number % 2 ** bits[0], (number >> bits[0]) % 2 ** bits[1], number >> (bits[0] + bits[1])])
        on_axes = self.arrays["color_low"][chunk] / 32 + (cell + 0.5) * 2.0 ** (size / 16 - 6) / 2.0 ** np.array(bits)
        on_axes = turned([*self.arrays["color_turn"][chunk], 306], on_axes)
        axes = np.array([[1, 1, 1] / np.sqrt(3), [1, 0, -1] / np.sqrt(2), [1, -2, 1] / np.sqrt(6)])
        return (on_axes @ axes).clip(0, 255) / 255

    def atoms(self, i: int) -> list[tuple[int, int, float]]:
        bits = self.header["dictionary_bits"]
        width, first = bits + self.header["weight_bits"], self.before(i, "n_atoms")
        found = []
        for rank in range(self.batches[self.batch[i]]["n_atoms"]):
            entry = self.field("codes", i // 8192, (first + rank) * width, width)
            atom, turn = divmod(entry % 2**bits, self.header["n_turns"])
            found.append(
                (
                    atom,
                    turn,
                    float(self.arrays["weight_levels"][rank, entry >> bits]) * float(self.arrays["atom_scale"][atom]),
                )
            )
        return found

    def map(self, k: int) -> Map:
        """Colours and depth codes of a map."""
        frames = self.header["maps"]
        at_color = sum(f["color_bytes"] for f in frames[:k])
        at_texel = sum(6 * f["height_px"] ** 2 for f in frames[:k])
        height, n = frames[k]["height_px"], 6 * frames[k]["height_px"] ** 2
        with Image.open(BytesIO(self.arrays["map_colors"][at_color : at_color + frames[k]["color_bytes"]])) as picture:
            color = np.array(picture.convert("RGB"))
        q = [self.arrays[f"map_depth_{name}"][at_texel : at_texel + n].astype(int) for name in ("low", "high")]
        q = q[0] + 256 * q[1]
        codes = np.where(q % 2, -(q + 1) // 2, q // 2).reshape(height, 6 * height).cumsum(axis=0) % 65536
        return Map(np.array(frames[k]["centre"]), height, frames[k]["nearest"], frames[k]["depth_step"], color, codes)

    def splat(self, i: int) -> Decoded:
        frame, batch, line, axes = self.frame(i), self.batches[self.batch[i]], None, None
        if batch["clipline"]:
            q = self.field("cliplines", i // 8192, 12 * self.before(i, "clipline"), 12)
            line = np.array([q & 15, q >> 4 & 15, q >> 8]) / 7 - 1
        if batch.get("ellipsoid"):
            word = self.field("ellipsoids", i // 8192, 32 * self.before(i, "ellipsoid"), 32)
            t = (word & 255) * np.pi / 256
            lengths = self.radius(i) * 2.0 ** ((np.array([word >> 8 & 255, word >> 16 & 255, word >> 24]) - 191) / 32)
            u, v, normal = frame
            axes = lengths[:, None] * np.array([np.cos(t) * u + np.sin(t) * v, np.cos(t) * v - np.sin(t) * u, normal])
        station = int(self.arrays["station"][i]) if "station" in self.arrays else 255
        station = -1 if station == 255 else station
        return Decoded(self.position(i), self.radius(i), frame, self.color(i), self.atoms(i), line, station, axes)

    def shipped(self, path: Path) -> dict[str, np.ndarray]:
        """What a file that names a dictionary lacks, of that dictionary's file."""
        raw = Zstd().decode(path.read_bytes())
        n = len(raw) // 772
        planes = np.frombuffer(raw, np.int8, 768 * n).reshape(3, n, 16, 16).astype(int)
        texels = 2 * np.stack([planes[0] + planes[1], planes[0], planes[0] + planes[2]], axis=-1)
        scale = np.frombuffer(raw, "<f4", n, 768 * n)
        digest = hashlib.sha256(texels.astype(np.int8).tobytes() + scale.tobytes()).hexdigest()
        assert digest == self.header["shipped"]
        texels, found = texels[: self.header["n_dictionary"]], {"atom_scale": scale}
        for size in (16, 8, 4, 2, 1):
            blocks = texels.reshape(len(texels), size, 16 // size, size, 16 // size, 3)
            found[f"atoms_{size}"] = np.round(blocks.mean(axis=(2, 4)))
        return found

    def sum_of_atoms(self, atoms: list[tuple[int, int, float]], place: np.ndarray, level: int) -> np.ndarray:
        """(m, 3) at the places (m, 2), at a level: 0 has 32 texels to a side."""
        size, total = 32 >> level, np.zeros((len(place), 3))
        for atom, turn, weight in atoms:
            x, y = (place[:, ::-1] if turn & 4 else place).T
            x, y = (-x if turn & 1 else x), (-y if turn & 2 else y)
            texels = self.arrays[f"atoms_{size}"][atom].astype(float)
            near = [
                np.maximum(0, 1 - np.abs(((at + 1) / 2 * size - 0.5).clip(0, size - 1)[:, None] - np.arange(size)))
                for at in (y, x)
            ]
            total += weight * np.einsum("mi,mj,ijc->mc", *near, texels)
        return total

    def patch_color(self, splat: Decoded, place: np.ndarray, area_px: float | None) -> np.ndarray:
        """(m, 3) linear light at places (m, 2) of the square."""
        if not splat.atoms:
            return np.tile(to_linear(splat.color), (len(place), 1))
        finest, coarsest = (5 - int(np.log2(self.header[name])) for name in ("atom_size", "coarsest_size"))
        level = 0.0 if area_px is None else 0.5 * np.log2(128 / max(area_px, 0.25))
        level = min(max(level, finest), coarsest)
        if "level_blending" in self.header.get("effects", {}):
            finer, share = int(np.floor(level)), level - np.floor(level)
            coarser = min(finer + 1, coarsest)
            total = sum(
                part * self.sum_of_atoms(splat.atoms, place, at) for part, at in ((1 - share, finer), (share, coarser))
            )
        else:
            total = self.sum_of_atoms(splat.atoms, place, min(int(np.floor(level + 0.45)), coarsest))
        return to_linear((splat.color + total).clip(0, 1))


def to_linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def render(packed: Packed, view: View) -> tuple[np.ndarray, np.ndarray]:
    """The picture (h, w, 3) in [0, 1], sRGB, and where it is covered (h, w)."""
    splats = [packed.splat(i) for i in range(len(packed))]
    drawn = [
        fragments(
            splat,
            view,
            NEAR_IN_RADII * packed.header["radius"],
            packed.header["margin_radii"],
            1 - share_looked_up(packed, view, splat) if packed.header.get("maps") else 0.0,
        )
        for splat in splats
    ]
    tiers, colors = zip(*(map_tiers(packed, view, *pair) for pair in zip(splats, drawn, strict=True)), strict=True)
    n_pixels = view.width_px * view.height_px
    surface, light, weights = np.full(n_pixels, np.inf), np.zeros((n_pixels, 3)), np.zeros(n_pixels)
    for found, tier in zip(drawn, tiers, strict=True):
        np.minimum.at(surface, found.pixel[found.hides], (found.pushed_z * tier)[found.hides])
    for found, tier, color in zip(drawn, tiers, colors, strict=True):
        if len(found.pixel):
            weight = (1 - found.d2) * (found.z * tier <= surface[found.pixel]) * np.isfinite(tier)
            np.add.at(light, found.pixel, weight[:, None] * color)
            np.add.at(weights, found.pixel, weight)
    covered = weights >= LEAST_WEIGHT
    picture = np.zeros((n_pixels, 3))
    picture[covered] = to_srgb((light[covered] / weights[covered, None]).clip(0, 1))
    return picture.reshape(view.height_px, view.width_px, 3), covered.reshape(view.height_px, view.width_px)


def share_looked_up(packed: Packed, view: View, splat: Decoded) -> float:
    if splat.station < 0:
        return 0.0
    seen, to_eye = packed.map(splat.station & 127), splat.position - view.centre
    z, share = (view.rotation @ to_eye)[2], 1.0
    if splat.station >= 128:
        middle = splat.position - seen.centre
        cosine = middle @ to_eye / np.linalg.norm(middle) / np.linalg.norm(to_eye)
        share = float(np.clip((cosine - 0.866) / 0.1, 0, 1))
    if z <= 0:
        return share
    n_px = splat.radius * max(view.fx_px, view.fy_px) / z
    n_texels = splat.radius / np.linalg.norm(splat.position - seen.centre) * seen.height * 2 / np.pi
    return share * float(np.clip((n_px / np.clip(n_texels / 2, 2.5, 16) - 1) / 0.25, 0, 1))


SECOND = 2.0**40  # what depths of the second tier are times, to lie behind all of the first


def map_tiers(packed: Packed, view: View, splat: Decoded, found: Fragments) -> tuple[np.ndarray, np.ndarray]:
    """What depths of fragments are times, infinite where the map leaves them free, and their colours (m, 3) in linear
    light."""
    color = packed.patch_color(splat, found.place, found.area_px)
    tier = np.ones(len(color))
    share = share_looked_up(packed, view, splat)
    if share == 0:
        return tier, color
    seen = packed.map(splat.station & 127)
    middle = splat.position - seen.centre
    axes = splat.radius * splat.frame[:2] if splat.axes is None else splat.axes[:2]
    across, away, texel = np.cross(*axes), np.linalg.norm(middle), np.pi / 2 / seen.height
    along = abs(middle @ across) / np.linalg.norm(across)
    slope = min(10, np.sqrt(max(away**2 - along**2, 0)) / max(along, 1e-30))
    slack = 0.0075 * away + 0.5 * splat.radius + texel * away * slope
    level = 0
    if found.area_px is not None:
        n_texels = abs(middle @ across) / (away * (texel * away) ** 2)
        level = int(np.floor(max(0.0, 0.5 * np.log2(n_texels / 2 / max(found.area_px, 0.25))) + 0.45))
    level, to_eye = min(level, 4), splat.position - view.centre
    moves = slack * np.linalg.norm(np.cross(middle, to_eye)) > 0.5 * texel * away**2 * np.linalg.norm(to_eye)
    for i, place in enumerate(found.place):
        f = middle + (place @ axes if found.ball is None else found.ball[i] @ splat.axes)
        what, fit = ("hidden", []) if slack > np.linalg.norm(f) / 2 else seen.shown(f, slack, level)
        if what == "shown" and level == 0 and moves:
            f = seen.moved(f, fit, view.centre - seen.centre, across / np.linalg.norm(across))
            what, fit = seen.shown(f, slack, level)
        trimmed = found.d2[i] >= 1 - share * {"shown": 0.0, "hidden": 0.75, "free": 1.0}[what]
        tier[i] = np.inf if trimmed else SECOND if what == "hidden" and found.d2[i] >= 1 - share else 1.0
        if what == "shown":
            color[i] = to_linear((share * seen.look_up(f, fit, level) + (1 - share) * 255 * to_srgb(color[i])) / 255)
    return tier, color


def fragments(splat: Decoded, view: View, near: float, margin_radii: float, clipped_from: float) -> Fragments:
    radius, middle = splat.radius, view.rotation @ (splat.position - view.centre)
    if splat.axes is None:
        return _of_disc(
            middle,
            radius * splat.frame[:2] @ view.rotation.T,
            radius,
            (splat.clipline, clipped_from),
            view,
            near,
            (margin_radii, radius),
        )
    axes = splat.axes @ view.rotation.T
    eye = np.linalg.solve(axes.T, -middle)
    distance = np.linalg.norm(eye)
    if distance <= 1:
        return Fragments(np.zeros(0, int), np.zeros((0, 2)), *np.zeros((3, 0)), np.zeros(0, bool), None)
    e = eye / distance
    x = np.cross(e, np.eye(3)[np.argmin(np.abs(e))])
    x /= np.linalg.norm(x)
    across = np.array([x, np.cross(e, x)])
    half_axes = np.sqrt((distance - 1) / (distance + 1)) * across @ axes
    found = _of_disc(
        middle + e @ axes, half_axes, np.sqrt((half_axes**2).sum()), (None, 0.0), view, near, (margin_radii, radius)
    )
    on_rim = found.place / np.maximum(1, np.linalg.norm(found.place, axis=1, keepdims=True))
    k = np.sqrt((1 - (on_rim**2).sum(axis=1)).clip(0))
    ball = (np.sqrt(distance**2 - 1) * on_rim @ across + (1 + distance * k)[:, None] * e) / (distance + k)[:, None]
    deeper = (distance + 1) / (distance + np.sqrt(1 - found.d2))
    return Fragments(
        found.pixel, ball[:, :2], found.d2, found.z * deeper, found.pushed_z * deeper, found.hides, found.area_px, ball
    )


def _of_disc(middle, axes, radius, clipped, view: View, near: float, margin: tuple[float, float]) -> Fragments:
    """Of the disc around `middle` (3,) with the half axes (2, 3), in the view's axes; `clipped` by a line from a squared
    distance on; `margin` in radii, and of what radius."""
    line, clipped_from = clipped
    column, row = np.meshgrid(np.arange(view.width_px) + 0.5, np.arange(view.height_px) + 0.5)
    px, focal, principal = (
        np.column_stack([column.ravel(), row.ravel()]),
        np.array([view.fx_px, view.fy_px]),
        np.array([view.cx_px, view.cy_px]),
    )
    jacobian, area_px = None, None
    if middle[2] > 2 * radius:
        jacobian = (focal * (axes[:, :2] - middle[:2] / middle[2] * axes[:, 2:]) / middle[2]).T
        area_px = abs(np.linalg.det(jacobian))
    if jacobian is not None and np.linalg.svd(jacobian, compute_uv=False)[1] < 1:
        offset = px - (focal * middle[:2] / middle[2] + principal)
        left, singular, right = np.linalg.svd(jacobian)
        place = offset @ left / np.maximum(singular, SMALLEST_PX) @ right
        in_radii, in_px, z = (place**2).sum(axis=1), (offset**2).sum(axis=1), np.full(len(px), middle[2])
    else:
        ray = np.column_stack([(px - principal) / focal, np.ones(len(px))])
        normal = np.cross(*axes)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (middle @ normal) / (ray @ normal)
            place = np.linalg.lstsq(axes.T, (ray * z[:, None] - middle).T, rcond=None)[0].T
        in_radii, in_px = (place**2).sum(axis=1), np.full(len(px), np.inf)
    with np.errstate(invalid="ignore"):
        d2, hides = np.minimum(in_radii, in_px), (in_radii < 0.7) | (in_px < 0.25)
        kept = (d2 < 1) & (z >= near) & (line is None or (d2 < clipped_from) | (place @ line[:2] + line[2] >= 0))
    pushed_by = margin[0] * max(margin[1], middle[2] / min(view.fx_px, view.fy_px))
    pushed_z = z * (1 + pushed_by / np.linalg.norm(middle) + NUDGE)
    return Fragments(np.flatnonzero(kept), place[kept], d2[kept], z[kept], pushed_z[kept], hides[kept], area_px)
