"""A COLMAP workspace with more or fewer points than it has: what scaling is measured on."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

RECORD = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 3)])
_HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {n}\n"
    + "".join(f"property float {p}\n" for p in ("x", "y", "z", "nx", "ny", "nz"))
    + "".join(f"property uchar {p}\n" for p in ("red", "green", "blue"))
    + "end_header\n"
)


def resized(scan: Path, folder: Path, n_points: int, spacing: float) -> Path:
    """`scan` with `n_points` points: an even choice of them, or all of them again and again, each time pushed along the
    surface by up to `spacing`. Photographs and what each point is seen by stay; compress it with a fixed radius, so
    that patches show what they did, and a splat costs what it did."""
    points, seen, ends = _points_of(scan)
    rng = np.random.default_rng(0)
    folder.mkdir(parents=True)
    for name in ("images", "sparse"):
        shutil.copytree(scan / name, folder / name)  # readers follow no links out of a scan
    with open(folder / "fused.ply", "wb") as ply, open(folder / "fused.ply.vis", "wb") as vis:
        ply.write(_HEADER.format(n=n_points).encode())
        vis.write(np.uint64(n_points).tobytes())
        for start in range(0, n_points, len(points)):
            n = min(len(points), n_points - start)
            chosen = np.sort(rng.permutation(len(points))[:n])
            rows = points[chosen].copy()
            if start:
                push = rng.uniform(-spacing, spacing, (n, 3))
                normal = rows["normal"]
                rows["position"] += push - (push * normal).sum(axis=1, keepdims=True) * normal
            ply.write(rows.tobytes())
            vis.write(np.concatenate([seen[ends[i] : ends[i + 1]] for i in chosen]).tobytes())
    return folder


def _points_of(scan: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points; the lists of what they are seen by, end to end; where each list begins and the last ends."""
    data = (scan / "fused.ply").read_bytes()
    header, body = data.split(b"end_header\n", 1)
    n = int(header.split(b"element vertex ")[1].split()[0])
    points = np.frombuffer(body, RECORD, n)
    seen = np.frombuffer((scan / "fused.ply.vis").read_bytes(), "<u4", offset=8)
    ends, at = np.empty(n + 1, np.int64), 0
    for i in range(n):
        ends[i] = at
        at += 1 + int(seen[at])
    ends[n] = at
    return points, seen, ends
