"""What entropy coding could make of a packed file's textures on disk: bits a splat by adaptive models, beside what zstd
leaves in the file.

    python -m benchmarks.entropy PACKED [--json]

Code lengths are those of an adaptive coder that begins knowing nothing: of a context with counts n_s of k symbols,
log2 G(n + k/2) / G(k/2) - sum of log2 G(n_s + 1/2) / G(1/2) bits (Krichevsky and Trofimov 1981), whatever their order.
So they are what an arithmetic coder with these contexts would take, its models included, to a few bytes. Chunks of
128 splats and batches stand as in the file; only a support's order is not told again where it says nothing.
"""

from __future__ import annotations

import argparse
import json
import zipfile
from pathlib import Path

import numpy as np
from scipy.special import gammaln

from storage.packed.packed import PackedFile, PackedScene
from storage.packed.schema import CHUNK, color_bits

ARRAYS = ("codes", "batch_count", "colors", "color_low", "color_size", "color_turn", "atoms")


def adaptive_bits(symbol: np.ndarray, n_symbols: int, context: np.ndarray | int = 0) -> float:
    """Bits of symbols (n,) of `n_symbols`, each by the model of its `context` (n,)."""
    context = np.broadcast_to(context, symbol.shape)
    _, model = np.unique(context, return_inverse=True)
    key, counts = np.unique(model.astype(np.int64) * n_symbols + symbol, return_counts=True)
    total, seen = np.bincount(model), key // n_symbols
    n = total[: seen.max() + 1] if len(seen) else total
    bits = gammaln(n + n_symbols / 2) - gammaln(n_symbols / 2)
    return float((bits.sum() - (gammaln(counts + 0.5) - gammaln(0.5)).sum()) / np.log(2))


def of_codes(scene: PackedScene) -> dict[str, float]:
    header, n_atoms = scene.header, scene.n_atoms
    atom, weight = scene.codes()
    used = np.arange(atom.shape[1]) < n_atoms[:, None]
    rank, many = np.nonzero(used)[1], np.broadcast_to(n_atoms[:, None], used.shape)[used]
    index, code = atom[used], weight[used]
    straight, turn = index // header.n_turns, index % header.n_turns
    return {
        "indices, one model": adaptive_bits(index, header.n_indices),
        "indices, a model a rank": adaptive_bits(index, header.n_indices, rank),
        "atoms, then turns by atom": adaptive_bits(straight, header.n_dictionary)
        + adaptive_bits(turn, header.n_turns, straight),
        "weights, a model a rank and support": adaptive_bits(code, 2**header.weight_bits, rank * 32 + many),
        "weights, also by atom": adaptive_bits(
            code, 2**header.weight_bits, (rank.astype(np.int64) * 32 + many) << 20 | straight
        ),
    }


def of_batches(scene: PackedScene) -> dict[str, float]:
    counts = scene.arrays["batch_count"].astype(np.int64)
    before = np.concatenate([counts[:1], counts[:-1]])
    near = np.minimum(np.ceil(np.log2(before + 1)).astype(int), 7)
    batch = np.broadcast_to(np.arange(counts.shape[1]), counts.shape)
    return {
        "counts of batches, by the chunk before": adaptive_bits(counts.ravel(), CHUNK + 1, (batch * 8 + near).ravel())
    }


def of_colors(scene: PackedScene) -> dict[str, float]:
    """Cells less those of the splat before, in its chunk."""
    header, n = scene.header, scene.header.n_splats
    if not header.color_step:
        return {}
    bits = color_bits(scene.arrays["color_size"], header.color_step)
    chunk, place = np.divmod(np.arange(n), CHUNK)
    shift, found = np.zeros(n, np.int64), {"cells": 0.0, "cells less those before": 0.0}
    for axis in range(3):
        width = bits[chunk, axis]
        cell = (scene.color_cells.astype(np.int64) >> shift) & ((1 << width) - 1)
        shift += width
        step = np.where(place > 0, cell - np.roll(cell, 1), cell)
        step = (step + (1 << width >> 1)) & ((1 << width) - 1)
        for name, values in (("cells", cell), ("cells less those before", step)):
            for wide in range(1, width.max() + 1):
                found[name] += adaptive_bits(values[width == wide], 1 << wide)
    low, size, turn = (scene.arrays[name].astype(np.int64) for name in ("color_low", "color_size", "color_turn"))
    found["boxes, less those before"] = sum(
        adaptive_bits(values % k, k)
        for table, k in ((low, 65536), (size, 256), (turn, 256))
        for values in (np.diff(table[:, axis], prepend=0) for axis in range(3))
    )
    return found


def measure(path: Path) -> dict:
    with PackedFile(path) as packed:
        scene = packed.load()
    n, stored = scene.header.n_splats, dict.fromkeys(ARRAYS, 0)
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            name = member.filename.split("/")[0]
            key = "atoms" if name.startswith(("atoms_", "atom_scale")) else name
            if key in stored:
                stored[key] += member.compress_size
    models = of_codes(scene) | of_batches(scene) | of_colors(scene)
    return {
        "splats": n,
        "file_bytes": path.stat().st_size,
        "stored_bits": {name: 8 * value / n for name, value in stored.items()},
        "model_bits": {name: value / n for name, value in models.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("packed", type=Path)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = measure(options.packed)
    if options.json:
        print(json.dumps(found))
        return
    print(
        f"{found['splats']:,} splats, {found['file_bytes']:,} bytes, {8 * found['file_bytes'] / found['splats']:.2f} bits a splat"
    )
    for title, rows in (("in the file", found["stored_bits"]), ("by adaptive models", found["model_bits"])):
        print(title)
        for name, bits in rows.items():
            print(f"  {name:42}{bits:8.2f} bits a splat")


if __name__ == "__main__":
    main()
