"""A group of a file in archive form, decoded by docs/FORMAT.md alone ("Archive form"): slow, and nothing of the product."""

from __future__ import annotations

import numpy as np

SIGNED = 98
SHIFTS = [1] + [2] * 2 + [3] * 4 + [4] * 8 + [5] * 16 + [6] * 32
# Rows of chunks of the page's table: bytes of a number, numbers, whether its lower two bytes are even bits.
TABLES = {
    "box_low": (4, 3), "box_size": (4, 3), "box_bits": (1, 3), "size_scale": (1, 2), "frame_origin": (4, 3),
    "frame_turn": (1, 3), "frame_step": (2, 1), "frame_cells": (2, 2), "frame_curve": (1, 3), "frame_bits": (1, 1),
    "normal_low": (2, 2), "normal_cells": (1, 2), "normal_slope": (1, 4), "normal_grid": (1, 1), "color_low": (2, 3),
    "color_size": (1, 3),
}  # fmt: skip


class Coder:
    """The range coder, and models numbered from 0."""

    def __init__(self, data: bytes, n_models: int) -> None:
        self.data, self.at, self.code, self.range = data, 4, int.from_bytes(data[:4], "big"), 2**32 - 1
        self.p, self.t = [32768] * n_models, [0] * n_models

    def by(self, bound: int) -> int:
        bit = 0 if self.code < bound else 1
        self.code, self.range = (self.code - bound, self.range - bound) if bit else (self.code, bound)
        while self.range < 2**24:
            byte = self.data[self.at] if self.at < len(self.data) else 0
            self.range, self.code, self.at = self.range << 8, self.code << 8 | byte, self.at + 1
        return bit

    def bit(self, model: int) -> int:
        p, shift = self.p[model], SHIFTS[self.t[model]]
        found = self.by((self.range >> 12) * (p >> 4))
        self.p[model] = p - ((p - 16) >> shift) if found else p + ((65520 - p) >> shift)
        self.t[model] = min(62, self.t[model] + 1)
        return found

    def share(self, a: int, b: int) -> int:
        return self.by((self.range >> 12) * max(1, min(4095, 4096 * a // b)))

    def even(self, bits: int) -> int:
        value = 0
        for _ in range(bits):
            value = 2 * value + self.by((self.range >> 12) * 2048)
        return value

    def tree(self, base: int, bits: int) -> int:
        node = 1
        for _ in range(bits):
            node = 2 * node + self.bit(base + node)
        return node - 2**bits

    def signed(self, base: int) -> int:
        n = 0
        while n < 34 and self.bit(base + n):
            n += 1
        if not n:
            return 0
        by = min(n, 15)
        negative, size = self.bit(base + 34 + by), 1
        if n > 1:
            size = 2 + self.bit(base + 50 + by)
        if n > 2:
            size = 2 * size + self.bit(base + 66 + 2 * by + (size & 1))
        if n > 3:
            size = size << (n - 3) | self.even(n - 3)
        return -size if negative else size


def length(x) -> int:
    return int(abs(x)).bit_length()


class Sets:
    """Where the sets of models begin."""

    def __init__(self, header: dict, n_table_bytes: int) -> None:
        d = len(header["batches"])
        self.batch_bits = length(d - 1)
        sizes = {
            "counts": 9 * 8 * 16, "many": 9 * SIGNED, "batches": 2 * (d + 1) << self.batch_bits, "sizes": 64 * 16,
            "a": 13 * SIGNED, "b": 52 * SIGNED, "heights": 16 * SIGNED, "colours": 156 * SIGNED, "sources": 520,
            "cliplines": 768, "ellipsoids": 1024, "atoms": 1 << header["dictionary_bits"],
            "weights": 256 << header["weight_bits"], "axes": 4, "tables": 256 * n_table_bytes,
        }  # fmt: skip
        self.n = 0
        for name, n in sizes.items():
            setattr(self, name, self.n)
            self.n += n


def decode_group(header: dict, data: bytes, n: int) -> tuple[dict, list[dict]]:
    """The tables of a group of `n` splats, and its splats in the order in which they are told."""
    assert data[0] == 0
    boxes = "geometry" not in header
    names = [name for name in TABLES if _is_there(name, header, boxes)]
    sets = Sets(header, sum(TABLES[name][0] * TABLES[name][1] for name in names))
    coder, n_chunks = Coder(data[1:], sets.n), -(-n // 128)
    tables = _tables(coder, sets, names, n_chunks)
    axes = [coder.tree(sets.axes, 2) for _ in range(n_chunks)] if boxes else [2] * n_chunks
    splats = []
    for chunk in range(n_chunks):
        row = {name: values[chunk] for name, values in tables.items()}
        splats += _Chunk(header, coder, sets, row, axes[chunk], boxes).splats(min(128, n - 128 * chunk))
    assert coder.at == len(data) - 1
    return tables, splats


def _is_there(name: str, header: dict, boxes: bool) -> bool:
    if name.startswith("color_"):
        return header["color_step"] > 0
    if name == "size_scale":
        return header["size_bits"] > 0
    return name.startswith("box_") == boxes


def _tables(coder: Coder, sets: Sets, names: list[str], n_chunks: int) -> dict[str, list]:
    tables: dict[str, list] = {name: [] for name in names}
    for _ in range(n_chunks):
        base = sets.tables
        for name in names:
            width, many = TABLES[name]
            row = []
            for _ in range(many):
                found = []
                for byte in range(width):
                    modelled = width < 4 or byte < 2
                    found.append(coder.tree(base, 8) if modelled else coder.even(8))
                    base += 256
                row.append(bytes(found))
            tables[name].append(row)
    return tables


def _number(raw: bytes) -> int:
    return int.from_bytes(raw, "big")


class _Chunk:
    def __init__(self, header, coder, sets, row, axis, boxes) -> None:
        self.header, self.coder, self.sets, self.boxes = header, coder, sets, boxes
        if boxes:
            self.axes = [a for a in range(3) if a != axis] + [axis]
            bits = [row["box_bits"][a][0] for a in self.axes]
            sides = [float(np.frombuffer(row["box_size"][a], ">f4")[0]) / 2.0**b for a, b in zip(self.axes, bits)]
            self.sides = [side / max(sides) if max(sides) > 0 else 1.0 for side in sides]
            self.cells, self.normals = [2**b for b in bits], [255, 255]
        else:
            self.normals = [row["normal_cells"][i][0] + 1 for i in range(2)]
            u, v = (_number(row["frame_cells"][i]) for i in range(2))
            states = u * v * self.normals[0] * self.normals[1]
            self.cells, self.sides = [u, v, -(-(2 ** row["frame_bits"][0][0]) // states)], [1.0, 1.0, 1.0]
        self.colors = [256] * 3
        if header["color_step"]:
            sizes = [row["color_size"][i][0] for i in range(3)]
            self.colors = [2 ** max(0, -((header["color_step"] - s) // 16)) for s in sizes]

    def places(self, n: int) -> list[tuple[int, int]]:
        waiting, found = [(n, 0, self.cells[0], 0, self.cells[1])], []
        while waiting:
            m, u, w, v, h = waiting.pop()
            if w * h == 1:
                found += [(u, v)] * m
                continue
            first = w > 1 and (h == 1 or w * self.sides[0] >= h * self.sides[1])
            x = w if first else h
            if m == 1:
                s = 1 - self.coder.share(x // 2, x)
            elif m <= 8:
                crowded = min(7, length(8 * w * h * n // (self.cells[0] * self.cells[1] * m)))
                s = self.coder.tree(self.sets.counts + 16 * (8 * m + crowded), 4)
            else:
                s = (m * (x // 2) + x // 2) // x + self.coder.signed(self.sets.many + SIGNED * length(m))
            half = x // 2
            second = (m - s, u + half, w - half, v, h) if first else (m - s, u, w, v + half, h - half)
            waiting += [second] if m - s else []
            waiting += [(s, u, half, v, h) if first else (s, u, w, v, half)] if s else []
        return found

    def splats(self, n: int) -> list[dict]:
        known: list[dict] = []
        for u, v in self.places(n):
            splat = {"u": u, "v": v}
            off = [
                (((u - o["u"]) * self.sides[0]) ** 2 + ((v - o["v"]) * self.sides[1]) ** 2, -i)
                for i, o in enumerate(known)
            ]
            near = [known[-i] for _, i in sorted(off)[:3]]
            near += [near[-1]] * (3 - len(near)) if near else []
            self.fields(splat, near)
            known.append(splat)
        return known

    def usual(self, near: list[dict], name: str, n: int) -> tuple[int, int]:
        if not near:
            return n // 2, 0
        x, y, z = (o[name] for o in near)
        return (2 * x + y + z + 2) // 4, 1 + min(11, length(max(x, y, z) - min(x, y, z)))

    def fields(self, splat: dict, near: list[dict]) -> None:
        coder, sets, header, d = self.coder, self.sets, self.header, len(self.header["batches"])
        splat["batch"] = 0
        if d > 1:
            usual = 2 * near[0]["batch"] + (near[0]["batch"] == near[1]["batch"]) if near else 2 * d
            splat["batch"] = coder.tree(sets.batches + (usual << sets.batch_bits), sets.batch_bits)
        if header["size_bits"]:
            usual = 2 * near[0]["size"] + near[1]["size"] + near[2]["size"] if near else 63
            splat["size"] = coder.tree(sets.sizes + 16 * usual, header["size_bits"])
        usual, spread = self.usual(near, "a", self.normals[0])
        off = coder.signed(sets.a + SIGNED * spread)
        splat["a"] = usual + off
        usual, spread = self.usual(near, "b", self.normals[1])
        splat["b"] = usual + coder.signed(sets.b + SIGNED * (4 * spread + min(3, length(off))))
        usual, spread = self.height(splat, near) if near and self.boxes else self.usual(near, "height", self.cells[2])
        splat["height"] = usual + coder.signed(sets.heights + SIGNED * spread)
        before = 0
        for f in range(3):
            usual, spread = self.usual(near, f"color{f}", self.colors[f])
            if near and not header["color_step"]:
                usual = min(max(usual + before, 0), 255)
            before = coder.signed(sets.colours + SIGNED * ((13 * f + spread) * 4 + min(3, length(before))))
            splat[f"color{f}"] = usual + before
        for i, (name, n) in enumerate([("camera", len(header["cameras"])), ("station", len(header.get("maps", [])))]):
            if n:
                splat[name] = self.source(name, n, near, sets.sources + 260 * i)
        batch = header["batches"][splat["batch"]]
        if batch["clipline"]:
            line = [coder.tree(sets.cliplines, 4)]
            line += [coder.tree(sets.cliplines + 16 * (16 + line[0]), 4)]
            splat["clipline"] = [*line, coder.tree(sets.cliplines + 16 * (32 + line[1]), 4)]
        if batch.get("ellipsoid"):
            splat["ellipsoid"] = [coder.tree(sets.ellipsoids + 256 * f, 8) for f in range(4)]
        splat["atoms"], before = [], 0
        for rank in range(batch["n_atoms"]):
            atom = coder.tree(sets.atoms, header["dictionary_bits"])
            weight = coder.tree(sets.weights + ((16 * rank + before) << header["weight_bits"]), header["weight_bits"])
            splat["atoms"].append((atom, weight))
            before = weight >> max(0, header["weight_bits"] - 4)

    def height(self, splat: dict, near: list[dict]) -> tuple[int, int]:
        n, said = self.cells[2], []
        for o in near:
            total = [x + y for x, y in zip(_normal(splat), _normal(o))]
            r = (splat["u"] - o["u"]) * self.sides[0] * total[self.axes[0]]
            r += (splat["v"] - o["v"]) * self.sides[1] * total[self.axes[1]]
            s, g = self.sides[2] * total[self.axes[2]], float(o["height"])
            said.append(min(max(g - r / s, 0.0), n - 1.0) if abs(r) < n * abs(s) else g)
        mean = int(np.floor((2 * said[0] + said[1] + said[2]) / 4 + 0.5))
        return mean, 1 + min(14, length(np.floor(max(said) - min(said))))

    def source(self, name: str, n: int, near: list[dict], base: int) -> int:
        if near:
            x, y, z = (o[name] for o in near)
            if not self.coder.bit(base + (x == y) + 2 * (x == z)):
                return x
        low = max(0, length(n) - 8)
        return self.coder.tree(base + 4, length(n) - low) << low | self.coder.even(low)


def _normal(splat: dict) -> tuple[int, int, int]:
    a, b = splat["a"] - 127, splat["b"] - 127
    c = 127 - abs(a) - abs(b)
    if c >= 0:
        return a, b, c
    return (127 - abs(b)) * (1 if a >= 0 else -1), (127 - abs(a)) * (1 if b >= 0 else -1), c
