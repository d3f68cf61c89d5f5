"""A group of a file in archive form, decoded by docs/FORMAT.md alone ("Archive form"): slow, and nothing of the product."""

from __future__ import annotations

import math

import numpy as np

from tests.format_textures import Atoms, Square, normal_of, tree_of, turns_of

SIGNED = 98
SHIFTS = [1] + [2] * 2 + [3] * 4 + [4] * 8 + [5] * 16 + [6] * 32
SQUASH = [min(4095, max(1, round(4096 / (1 + math.exp(-x / 256))))) for x in range(-2048, 2048)]
STRETCH = [min(2047, max(-2047, round(256 * math.log(q / (4096 - q))))) for q in [0.5, *range(1, 4096)]]
# Columns of chunks in their order: how many, bits of a number, whether it has a sign; by the mean of late (m), by the
# one before (p), float (f), origin (o).
TABLES = {
    "box_low": (3, 32, 0, "f"), "box_size": (3, 32, 0, "f"), "box_bits": (3, 8, 0, "m"), "size_scale": (2, 8, 0, "p"),
    "frame_turn": (3, 8, 1, "m"), "frame_step": (1, 16, 0, "p"), "frame_cells": (2, 16, 0, "m"),
    "frame_curve": (3, 8, 1, "m"), "frame_bits": (1, 8, 0, "p"), "normal_low": (2, 16, 1, "p"),
    "normal_cells": (2, 8, 0, "m"), "normal_slope": (4, 8, 1, "m"), "normal_lean": (1, 8, 1, "m"),
    "normal_grid": (1, 8, 0, "p"),
    "color_low": (3, 16, 1, "p"), "color_size": (3, 8, 0, "p"), "color_turn": (3, 8, 1, "m"),
    "frame_origin": (3, 16, 0, "o"),
}  # fmt: skip
VALUES = [68, 128, 128, 272, 256, 136]  # signed sets of a value's six models


class Coder:
    """The range coder, and models numbered from 0."""

    def __init__(self, data: bytes, n_models: int, n_sets: int) -> None:
        self.data, self.at, self.code, self.range = data, 4, int.from_bytes(data[:4], "big"), 2**32 - 1
        self.p, self.t = [32768] * n_models, [0] * n_models
        self.w = [[16384] * 7 for _ in range(n_sets)]

    def by(self, bound: int) -> int:
        bit = 0 if self.code < bound else 1
        self.code, self.range = (self.code - bound, self.range - bound) if bit else (self.code, bound)
        while self.range < 2**24:
            byte = self.data[self.at] if self.at < len(self.data) else 0
            self.range, self.code, self.at = self.range << 8, self.code << 8 | byte, self.at + 1
        return bit

    def bit(self, models: list[int], which: int = 0, masses: tuple = (0, 0)) -> int:
        n = len(models)
        said = [STRETCH[self.p[m] >> 4] for m in models]
        chance = self.p[models[0]] >> 4
        a, both = masses[0], masses[0] + masses[1]
        known = STRETCH[min(4095, max(1, int(np.float32(4096) * a / both)))] if both > 0 else 0
        if n > 1:
            w = self.w[which]
            total = (sum(x * y for x, y in zip(w, said)) + w[6] * known) * (6 // n) >> 16
            chance = SQUASH[min(2047, max(-2047, total)) + 2048]
        found = self.by((self.range >> 12) * chance)
        error = (0 if found else 4096) - chance
        for k, m in enumerate(models):
            if n > 1:
                w[k] += (said[k] * error + 2048) >> 12
            p, shift = self.p[m], SHIFTS[min(self.t[m], 62)]
            self.p[m] = p - ((p - 16) >> shift) if found else p + ((65520 - p) >> shift)
            self.t[m] += 1
        if known:
            w[6] += (known * error + 2048) >> 12
        return found

    def share(self, a: int, b: int) -> int:
        return self.by((self.range >> 12) * max(1, min(4095, 4096 * a // b)))

    def even(self, bits: int) -> int:
        value = 0
        for _ in range(bits):
            value = 2 * value + self.by((self.range >> 12) * 2048)
        return value

    def tree(self, bases: list[int], bits: int, which: int = 0, masses: list | None = None) -> int:
        node = 1
        for _ in range(bits):
            known = (masses[2 * node], masses[2 * node + 1]) if masses else (0, 0)
            node = 2 * node + self.bit([base + node for base in bases], which + min(31, node), known)
        return node - 2**bits

    def signed(self, bases: list[int], which: int = 0) -> int:
        n = 0
        while n < 34 and self.bit([base + n for base in bases], which + min(n, 11)):
            n += 1
        if not n:
            return 0
        by = min(n, 15)
        negative, size = self.bit([base + 34 + by for base in bases], which + 12), 1
        if n > 1:
            size = 2 + self.bit([base + 50 + by for base in bases], which + 13)
        if n > 2:
            size = 2 * size + self.bit([base + 66 + 2 * by + (size & 1) for base in bases], which + 14)
        if n > 3:
            size = size << (n - 3) | self.even(n - 3)
        return -size if negative else size


def length(x) -> int:
    return int(abs(x)).bit_length()


def octaves(x: float) -> int:
    n = length(int(min(x, 2.0**40)))
    return 2 * n + (int(min(x, 2.0**40)) >> (n - 2) & 1 if n > 1 else 0)


class Sets:
    """Where the models of each kind begin, and the sets of weights."""

    def __init__(self, header: dict, n_columns: int) -> None:
        b = len(header["batches"])
        self.batch_bits, self.turn_bits = length(b - 1), length(header["n_turns"] - 1)
        self.atom_bits = header["dictionary_bits"] - self.turn_bits
        atoms, levels = 1 << self.atom_bits, 1 << header["weight_bits"]
        sizes = {
            "counts": 9 * 8 * 16, "many": 9 * SIGNED, "values": 6 * sum(VALUES) * SIGNED,
            "batches": (2 * (b + 1) + (b + 1) ** 2 + 3 * 34 * 34) << self.batch_bits,
            "sizes": (64 + 17 * 17 + 2 * 62 * 64) * 16,
            "sources": 2 * (4 + 72 + 257 * 9 + 136 + 515 * 256), "cliplines": 3 * 272 * 16, "ellipsoids": 1024,
            "atoms": 9 * atoms, "turns": (1 + atoms) << self.turn_bits,
            "weights": (256 + 256 * 17 + 512 + 512 + 257) * levels, "axes": 4, "tables": n_columns * 33 * SIGNED,
        }  # fmt: skip
        self.n = 0
        for name, n in sizes.items():
            setattr(self, name, self.n)
            self.n += n
        names = [
            "batch",
            "size",
            "same",
            "source",
            "line",
            "line2",
            "line3",
            "atom",
            "turn",
            *[f"weight{r}" for r in range(4)],
        ]
        self.w = {name: 90 + 32 * i for i, name in enumerate(names)}
        self.w_axes = 90 + 32 * len(names)
        self.w_tables = self.w_axes + 4
        self.n_sets = self.w_tables + 15 * n_columns


def decode_group(header: dict, data: bytes, n: int, dictionary: tuple | None = None) -> tuple[dict, list[dict]]:
    """The tables of a group of `n` splats, and its splats in the order in which they are told. `dictionary`: texels of
    the finest level, scales, weights."""
    looked_at = dictionary is not None and header["n_turns"] == 8 and header["n_dictionary"] <= 512
    atoms = Atoms(*dictionary) if looked_at and header["atom_size"] >= 8 else None
    assert data[0] == 0
    boxes = "geometry" not in header
    names = [name for name in TABLES if _is_there(name, header, boxes)]
    sets = Sets(header, sum(TABLES[name][0] for name in names))
    coder, n_chunks = Coder(data[1:], sets.n, sets.n_sets), -(-n // 128)
    tables = _tables(coder, sets, names, n_chunks)
    axes = [coder.tree([sets.axes], 2) for _ in range(n_chunks)] if boxes else [2] * n_chunks
    splats, late = [], {}
    for chunk in range(n_chunks):
        row = {name: values[chunk] for name, values in tables.items()}
        splats += _Chunk(header, coder, sets, row, axes[chunk], boxes, late, atoms).splats(min(128, n - 128 * chunk))
    assert coder.at == len(data) - 1
    return tables, splats


def _is_there(name: str, header: dict, boxes: bool) -> bool:
    if name.startswith("color_"):
        return header["color_step"] > 0
    if name == "size_scale":
        return header["size_bits"] > 0
    return name.startswith("box_") == boxes


def _tables(coder: Coder, sets: Sets, names: list[str], n_chunks: int) -> dict[str, list]:
    """Whole numbers; floats by the words of their bits."""
    tables: dict[str, list] = {name: [] for name in names}
    known: dict[int, list] = {}
    above = 0
    for chunk in range(n_chunks):
        column, left, row = 0, 0, {}
        for name in names:
            many, bits, sign, kind = TABLES[name]
            row[name] = []
            for i in range(many):
                base, which = sets.tables + column * 33 * SIGNED, sets.w_tables + 15 * column
                before, mean, size = known.get(column, [0, 0.0, 0])
                if kind == "o" and i == 0 and chunk == 0:
                    above = coder.even(8)
                bases = [base, base + (1 + size) * SIGNED, base + (17 + left) * SIGNED]
                off = coder.signed(bases, which)
                if kind == "o":
                    z = min(15, max(0, (row["frame_step"][0] >> 7) - above))
                    word = before = (before // 2**z + off) * 2**z
                elif kind == "f":
                    before += off
                    word = before << 16 | coder.even(16)
                else:
                    word = (math.floor(mean + 0.5) if kind == "m" else before) + off
                    before = word
                    mean += (word - mean) / 8
                left = min(length(off), 15)
                known[column] = [before, mean, left]
                row[name].append(word)
                column += 1
        for name in names:
            tables[name].append(row[name])
    return tables


class _Chunk:
    def __init__(self, header, coder, sets, row, axis, boxes, late, dictionary) -> None:
        self.late, self.row, self.dictionary = late, row, dictionary
        self.header, self.coder, self.sets, self.boxes = header, coder, sets, boxes
        self.sizes = 2 ** header["size_bits"]
        if boxes:
            self.axes = [a for a in range(3) if a != axis] + [axis]
            bits = [row["box_bits"][a] for a in self.axes]
            sides = [float(np.uint32(row["box_size"][a]).view(np.float32)) / 2.0**b for a, b in zip(self.axes, bits)]
            self.sides = [side / max(sides) if max(sides) > 0 else 1.0 for side in sides]
            self.cells, self.normals = [2**b for b in bits], [255, 255]
        else:
            self.axes = [0, 1, 2]
            self.normals = [row["normal_cells"][i] + 1 for i in range(2)]
            u, v = row["frame_cells"]
            if header["size_bits"]:
                low, high = row["size_scale"]
                self.sizes = min(16, 1 + (8 * (high - low) + 14) // 15)
            states = u * v * self.normals[0] * self.normals[1] * self.sizes
            self.cells, self.sides = [u, v, -(-(2 ** row["frame_bits"][0]) // states)], [1.0, 1.0, 1.0]
        self.colors = [256] * 3
        if header["color_step"]:
            sizes = row["color_size"]
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
                s = self.coder.tree([self.sets.counts + 16 * (8 * m + crowded)], 4)
            else:
                s = (m * (x // 2) + x // 2) // x + self.coder.signed([self.sets.many + SIGNED * length(m)])
            half = x // 2
            second = (m - s, u + half, w - half, v, h) if first else (m - s, u, w, v + half, h - half)
            waiting += [second] if m - s else []
            waiting += [(s, u, half, v, h) if first else (s, u, w, v, half)] if s else []
        return found

    def splats(self, n: int) -> list[dict]:
        known: list[dict] = []
        area = self.cells[0] * self.sides[0] * self.cells[1] * self.sides[1] / n
        for i, (u, v) in enumerate(self.places(n)):
            splat = {"u": u, "v": v, "off": {}}
            found = [
                (((u - o["u"]) * self.sides[0]) ** 2 + ((v - o["v"]) * self.sides[1]) ** 2, -j)
                for j, o in enumerate(known)
            ]
            found = sorted(found)[:8]
            self.near, self.place = [known[-j] for _, j in found], min(length(i), 7) // 2
            self.weight = [1 / (d + 0.3 * area + 1e-6) for d, _ in found]
            self.total = _sum(self.weight)
            self.far = sum(found[0][0] > area / 32 * 2**k for k in range(7)) if found else 0
            self.fields(splat)
            known.append(splat)
        return known

    def plane(self, splat: dict, said: list[float], mean: float, level: float) -> float:
        x = [(o["u"] - splat["u"]) * self.sides[0] for o in self.near]
        y = [(o["v"] - splat["v"]) * self.sides[1] for o in self.near]
        z, w, total = [g - mean for g in said], self.weight, self.total
        sx, sy, sz = (_sum([a * b for a, b in zip(w, c)]) for c in (x, y, z))
        sxx, sxy, syy, sxz, syz = (
            _sum([a * b * c for a, b, c in zip(w, p, q)]) for p, q in ((x, x), (x, y), (y, y), (x, z), (y, z))
        )
        xx, yy, xy = sxx - sx * sx / total + level, syy - sy * sy / total + level, sxy - sx * sy / total
        xz, yz = sxz - sx * sz / total, syz - sy * sz / total
        det = xx * yy - xy * xy
        return mean + (sz - sx * (xz * yy - yz * xy) / det - sy * (yz * xx - xz * xy) / det) / total

    def value(self, splat: dict, name: str, number: int, n: int, said: list, added: int, before: int) -> int:
        """Reads a field; returns how far it is off."""
        usual, spread, were, apart, late = n // 2, 0, 0, 0, self.late.get(name, 0.0)
        if said:
            mean = _sum([w * g for w, g in zip(self.weight, said)]) / self.total
            off = _sum([w * o["off"][name] for w, o in zip(self.weight, self.near)])
            squares = _sum([w * (g - mean) * (g - mean) for w, g in zip(self.weight, said)])
            free, held = (self.plane(splat, said, mean, level) for level in (0.3, 3.0))
            usual = math.floor(min(max((free + held) / 2, 0.0), n - 1.0) + 0.5) + added
            usual = min(max(usual, 0), n - 1)
            spread = 1 + min(14, length(int(min(2.0**40, 4 * squares / self.total))))
            were = 1 + min(15, octaves(4 * off / self.total))
            bend = free - (free + held) / 2
            apart = 2 * min(7, length(int(min(2.0**40, 2 * abs(bend))))) + (bend < 0)
        signs = 2 * min(3, abs(before)) + (before < 0)
        lately = min(15, octaves(4 * late))
        places = [
            were * 4 + self.place, spread * 8 + signs, spread * 8 + self.far, lately * 17 + were, apart * 16 + spread,
            were * 8 + min(7, length(before)),
        ]  # fmt: skip
        base = self.sets.values + number * sum(VALUES) * SIGNED
        bases = [base + (sum(VALUES[:k]) + place) * SIGNED for k, place in enumerate(places)]
        off = self.coder.signed(bases, 15 * number)
        splat[name] = usual + off
        splat["off"][name] = min(abs(off), n)
        self.late[name] = late + (splat["off"][name] - late) / 16
        return off

    def fields(self, splat: dict) -> None:
        coder, sets, header, near, d = self.coder, self.sets, self.header, self.near, len(self.header["batches"])
        three = (near + [near[-1]] * 2)[:3] if near else []
        splat["size"] = self.size(near, three) if self.sizes > 1 else 0
        before = 0
        for i, name in enumerate(("a", "b", "height")):
            said = [o[name] for o in near]
            if name == "height" and self.boxes:
                said = [self.height(splat, o) for o in near]
            before = self.value(splat, name, i, (*self.normals, self.cells[2])[i], said, 0, before)
        square, contrast = None, 0
        if self.dictionary:
            half = [2 * splat[k] + 1 - n for k, n in zip("uv", self.cells)]
            normal = normal_of(self.row, self.boxes, splat["a"], splat["b"], *half)
            square = Square(header, self.row, self.axes, self.boxes, self.sizes, splat, normal)
            place = [splat[name] * side for name, side in zip(("u", "v", "height"), self.sides)]
            square.see(place, [o["square"] for o in near])
        before = 0
        for f in range(3):
            added = 0 if header["color_step"] else before
            name = f"color{f}"
            before = self.value(splat, name, 3 + f, self.colors[f], [o[name] for o in near], added, before)
        if square:
            contrast = square.differ(square.light(header, self.row, [splat[f"color{f}"] for f in range(3)]))
        splat["batch"], splat["square"] = self.batch(near, three, d, contrast) if d > 1 else 0, square
        batch = header["batches"][splat["batch"]]
        for i, (name, n) in enumerate([("camera", len(header["cameras"])), ("station", len(header.get("maps", [])))]):
            if n:
                splat[name] = self.source(name, i, n, near, three, batch)
        if batch["clipline"]:
            line: list[int] = []
            for f in range(3):
                b, c = (line[::-1] + [0, 0])[:2]
                bases = [sets.cliplines + 16 * (16 * f + b), sets.cliplines + 768 + 16 * (256 * f + 16 * b + c)]
                line.append(coder.tree(bases, 4, sets.w["line"] + 32 * f))
            splat["clipline"] = line
        if batch.get("ellipsoid"):
            splat["ellipsoid"] = [coder.tree([sets.ellipsoids + 256 * f], 8) for f in range(4)]
        splat["atoms"] = self.atoms(batch["n_atoms"], square)

    def batch(self, near: list[dict], three: list[dict], d: int, contrast: int) -> int:
        batches, late = self.header["batches"], self.late.get("atoms", 0.0)
        first, second, atoms, lines = d, d, 0, 0
        if near:
            first, second = three[0]["batch"], three[1]["batch"]
            kinds = [batches[o["batch"]] for o in near]
            atoms = 1 + int(2 * _sum([w * k["n_atoms"] for w, k in zip(self.weight, kinds)]) / self.total)
            lines = 1 + int(6 * _sum([w * k["clipline"] for w, k in zip(self.weight, kinds)]) / self.total)
        rest = 2 * (d + 1) + (d + 1) ** 2
        places = [
            2 * first + (first == second), 2 * (d + 1) + first * (d + 1) + second, rest + 34 * atoms + lines,
            rest + 34 * 34 + 34 * atoms + int(2 * late), rest + 2 * 34 * 34 + 34 * atoms + contrast,
        ]  # fmt: skip
        bits = self.sets.batch_bits
        found = self.coder.tree([self.sets.batches + (p << bits) for p in places], bits, self.sets.w["batch"])
        self.late["atoms"] = late + (batches[found]["n_atoms"] - late) / 16
        return found

    def size(self, near: list[dict], three: list[dict]) -> int:
        usual, first, second, mean, late = 63, 16, 16, 61, self.late.get("size", 0.0)
        if near:
            first, second = three[0]["size"], three[1]["size"]
            usual = 2 * first + second + three[2]["size"]
            mean = int(4 * _sum([w * o["size"] for w, o in zip(self.weight, near)]) / self.total)
        places = [
            usual, 64 + 17 * first + second, 353 + 64 * mean + self.far, 353 + 62 * 64 + 64 * mean + int(4 * late)
        ]  # fmt: skip
        bases = [self.sets.sizes + 16 * place for place in places]
        found = self.coder.tree(bases, self.header["size_bits"], self.sets.w["size"])
        self.late["size"] = late + (found - late) / 8
        return found

    def atoms(self, n_atoms: int, square: Square | None) -> list[tuple[int, int]]:
        sets, coder, bits = self.sets, self.coder, self.header["weight_bits"]
        found, before, earlier = [], 0, 0
        for rank in range(n_atoms):
            bases = [sets.atoms, sets.atoms + (1 + min(rank, 7) << sets.atom_bits)]
            masses = square.look(self.dictionary) if square else None
            atom = coder.tree(bases, sets.atom_bits, sets.w["atom"], tree_of(masses, sets.atom_bits))
            bases = [sets.turns, sets.turns + (1 + atom << sets.turn_bits)]
            inside = square is not None and atom < len(self.dictionary.worth)
            knows = inside and masses is not None
            turn = coder.tree(bases, sets.turn_bits, sets.w["turn"], turns_of(masses[atom]) if knows else [])
            met = square.met(self.dictionary, rank, atom, turn, max(0, bits - 4)) if knows else 0
            place = 16 * rank + before
            places = [
                place, 256 + 17 * place + n_atoms, 256 * 18 + 2 * (16 * earlier + before) + (rank == 0),
                256 * 20 + (atom >> max(0, sets.atom_bits - 9)), 256 * 22 + met,
            ]  # fmt: skip
            weight = coder.tree([sets.weights + (p << bits) for p in places], bits, sets.w[f"weight{min(rank, 3)}"])
            if inside:
                square.add(self.dictionary, rank, atom, turn, weight)
            found.append((atom << sets.turn_bits | turn, weight))
            earlier, before = before, weight >> max(0, bits - 4)
        return found

    def height(self, splat: dict, o: dict) -> float:
        n = self.cells[2]
        total = [x + y for x, y in zip(_normal(splat), _normal(o))]
        r = (splat["u"] - o["u"]) * self.sides[0] * total[self.axes[0]]
        r += (splat["v"] - o["v"]) * self.sides[1] * total[self.axes[1]]
        s, g = self.sides[2] * total[self.axes[2]], float(o["height"])
        return min(max(g - r / s, 0.0), n - 1.0) if abs(r) < n * abs(s) else g

    def source(self, name: str, which: int, n: int, near: list[dict], three: list[dict], batch: dict) -> int:
        base = self.sets.sources + which * (4 + 72 + 257 * 9 + 136 + 515 * 256)
        low, first, second = max(0, length(n) - 8), 256, 256
        if near:
            x, y, z = (o[name] for o in three)
            others = [o[name] for o in near if o[name] != x]
            agree, alike = sum(o[name] == x for o in near), (x == y) + 2 * (x == z)
            first, second = x >> low, (others[0] if others else x) >> low
            kind = 2 * batch["n_atoms"] + batch["clipline"]
            places = [alike, 4 + 8 * agree + self.far - 8, 76 + 9 * first + agree, 76 + 257 * 9 + 34 * alike + kind]
            if not self.coder.bit([base + place for place in places], self.sets.w["same"] + which):
                return x
        trees = base + 76 + 257 * 9 + 136
        bases = [trees, trees + (1 + first << 8), trees + (258 + second << 8)]
        return self.coder.tree(bases, length(n) - low, self.sets.w["source"]) << low | self.coder.even(low)


def _sum(terms: list[float]) -> float:
    """One after the other, which the order of additions is."""
    total = 0.0
    for term in terms:
        total += term
    return total


def _normal(splat: dict) -> tuple[int, int, int]:
    a, b = splat["a"] - 127, splat["b"] - 127
    c = 127 - abs(a) - abs(b)
    if c >= 0:
        return a, b, c
    return (127 - abs(b)) * (1 if a >= 0 else -1), (127 - abs(a)) * (1 if b >= 0 else -1), c
