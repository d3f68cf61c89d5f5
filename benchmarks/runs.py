"""Points and iso-surfaces as runs of cells of the HCP grid, beside Table 1 of DuoDecim (2006): hit rate, efficiency, errors, bits a cell
on a graphics card and on disk, cells a second of a processor, and how long the compute shader takes.

    python -m benchmarks.runs SCAN.ply [VOLUME.nrrd=60 made:torus:mesh ...] [--json] [--no-gpu]

Every scan is sampled with slices across each axis; the one with the longest runs is kept. Of a volume the cells are those of its surface; `made` is what benchmarks/made_scans.py makes.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.made_scans import made
from pipeline.geometry.hcp import centres_of
from pipeline.geometry.normals import decode_normals
from pipeline.geometry.runs.cells import average_normals, in_grid, mean_spacing, search_size
from pipeline.geometry.runs.codes import RunCodes, cones, decode_runs, encode_runs, turn_across
from pipeline.geometry.runs.gaps import close_gaps
from pipeline.geometry.runs.starts import bits_of
from pipeline.geometry.runs.walks import RUN_LENGTH, runs_of
from pipeline.readers import open_scan
from pipeline.splats.normals import NEIGHBOURS, estimate_normals, usable_normals
from pipeline.volumes.field import SUPPORT
from pipeline.volumes.lattice import HALO, auto_size, lattice_of
from pipeline.volumes.open import open_volume
from pipeline.volumes.surface import sampled, surface_in
from storage.packed.runs.coded import GroupRuns, pack_runs
from storage.packed.scene import PackedScene
from storage.packed.schema import GROUP, RUNS, Batch, Header, RunGrid

TASK = 32  # slices of a volume at a time
REPEATS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scans", nargs="+", metavar="SCAN or VOLUME=ISO")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--no-gpu", action="store_true")
    options = parser.parse_args()
    rows = [row for scan in options.scans for row in rows_of(scan, not options.no_gpu)]
    if options.json:
        print(json.dumps(rows))
        return
    for row in rows:
        print("\n".join([row.pop("name"), *(f"  {name:<28} {_said(value)}" for name, value in row.items())]))


def _said(value) -> str:
    return f"{value:,.3f}" if isinstance(value, float) else str(value)


def rows_of(scan: str, gpu: bool) -> list[dict]:
    path, _, iso = scan.partition("=")
    _compile()
    if iso:
        key, normal, seconds = surface_cells(path, float(iso))
        return [row_of(f"{Path(path).name} iso {iso}", key, normal, {"extraction_s": seconds}, gpu)]
    position, normal = points_of(path)
    begun = time.perf_counter()
    cells, runs = max(
        ((c, runs_of(c.key)) for c in (search_size(position, axis=axis) for axis in range(3))),
        key=lambda x: x[1].mean_length,
    )
    seconds = time.perf_counter() - begun
    mean = average_normals(position, normal, cells)
    far = cKDTree(centres_of(cells.key, cells.size)).query(in_grid(position, cells.axis))[0]
    spacing = mean_spacing(position)
    facts = {
        "points": len(position), "hit_rate": cells.hit_rate, "axis": "xyz"[cells.axis], "sampling_s": seconds,
        "cell_in_spacings": cells.size / spacing, "max_error_in_cells": float(far.max() / cells.size),
        "mean_error_in_spacings": float(far.mean() / spacing),
    }  # fmt: skip
    rows = [row_of(Path(path).name, cells.key, mean, facts, gpu)]
    closed = close_gaps(cells.key)
    if closed.is_added.any():
        normals = np.zeros((len(closed.key), 3))
        normals[~closed.is_added] = mean
        centre = centres_of(closed.key, 1.0)
        normals[closed.is_added] = mean[cKDTree(centre[~closed.is_added]).query(centre[closed.is_added])[1]]
        rows.append(
            row_of(
                f"{Path(path).name}, gaps closed", closed.key, normals, {"added": float(closed.is_added.mean())}, gpu
            )
        )
    return rows


def _compile() -> None:
    key = np.arange(40, dtype=np.int64) + (1 << 20) * ((1 << 42) + (1 << 21) + 1)
    codes, _ = encode_runs(key, np.tile([0.0, 0.0, 1.0], (40, 1)), runs_of(key))
    decode_runs(codes)
    packed_groups(codes)


def row_of(name: str, key: np.ndarray, normal: np.ndarray, facts: dict, gpu: bool) -> dict:
    times = []
    for _ in range(2):
        begun = time.process_time()
        runs = runs_of(key)
        codes, place = encode_runs(key, normal, runs)
        times.append(time.process_time() - begun)
    begun = time.process_time()
    n_bytes = packed_groups(codes)
    packed_s = time.process_time() - begun
    _, code = decode_runs(codes)
    off = np.degrees(np.arccos(np.clip((decode_normals(code) * normal[place]).sum(axis=1), -1, 1)))
    bits = bits_of(codes)
    row = {"name": name, **facts, "cells": len(key), "runs": len(codes.start), "efficiency": runs.mean_length / RUN_LENGTH,
           "twice": len(runs.cells) / len(key) - 1, "gpu_bits": sum(bits.values()), **{f"gpu_bits_{k}": v for k, v in bits.items()},
           "disk_bits": 8 * (n_bytes + codes.codebook.nbytes) / codes.n_cells, "normals_off_degrees": float(off.mean()),
           "normals_off_p99_degrees": float(np.quantile(off, 0.99)), "culled_by_cones": culled(codes),
           "encode_cells_a_second": len(key) / min(times), "pack_cells_a_second": len(key) / packed_s}  # fmt: skip
    return row | ({"gpu_decode_ms": gpu_ms(codes)} if gpu else {})


def packed_groups(codes: RunCodes) -> int:
    """Bytes of all groups' runs, each alone, as a packed file has them."""
    begin = codes.first_run.astype(int) + codes.first_step
    n_bytes, sections = 0, np.append(np.flatnonzero(begin % GROUP == 0), len(begin))
    runs, steps = np.append(codes.first_run, len(codes.start)), np.append(codes.first_step, len(codes.step))
    for a, b in zip(sections, sections[1:]):
        r, s = slice(runs[a], runs[b]), slice(steps[a], steps[b])
        first = codes.first_run[a:b] - codes.first_run[a]
        n_bytes += len(pack_runs(GroupRuns(codes.base[a:b], first, codes.start[r], codes.normal[r], codes.step[s])))
    return n_bytes


def culled(codes: RunCodes) -> float:
    """Share of cells in groups whose cone faces away, of parallel views along six axes."""
    axis, half = cones(codes)
    begin = codes.first_run.astype(int) + codes.first_step
    n = np.diff([*begin, codes.n_cells])
    away = [n[np.arccos(np.clip(axis @ view, -1, 1)) > np.pi / 2 + half].sum() for view in (*np.eye(3), *-np.eye(3))]
    return float(np.mean(away) / codes.n_cells)


def gpu_ms(codes: RunCodes) -> float:
    from renderer.splats.context import gl_context
    from renderer.splats.upload.runs import upload_runs

    begin = codes.first_run.astype(int) + codes.first_step
    arrays = {"run_base": codes.base, "run_first": codes.first_run, "run_start": codes.start, "run_normal": codes.normal,
              "run_step": codes.step, "run_codebook": codes.codebook,
              "run_section": np.flatnonzero(begin % GROUP == 0).astype(np.uint32)}  # fmt: skip
    grid = RunGrid(1.0, turn_across(2), len(codes.base), len(codes.start))
    header = Header(codes.n_cells, 1.0, "m", (0.0, 0.0, 0.0), (0, 0, 1), (1, 0, 0), 1.0, 0, 1, 4, (Batch(0),), (), {}, {},
                    geometry=RUNS, runs=grid)  # fmt: skip
    with gl_context() as context:
        gpu = upload_runs(context, PackedScene(header, arrays))
        times = []
        for _ in range(REPEATS):
            begun = time.perf_counter()
            gpu.decode()
            context.finish()
            times.append(time.perf_counter() - begun)
        gpu.release()
    return 1000 * float(np.median(times))


def points_of(path: str) -> tuple[np.ndarray, np.ndarray]:
    if path.startswith("made:"):
        return made(*path.split(":")[1:])
    pieces = list(open_scan(path).pieces(1 << 16))
    position = np.concatenate([piece.position for piece in pieces])
    known = np.isfinite(position).all(axis=1)
    position = position[known] - position[known].mean(axis=0)
    if pieces[0].normal is not None:
        return position, usable_normals(np.concatenate([piece.normal for piece in pieces])[known])[0]
    near = cKDTree(position).query(position, NEIGHBOURS + 1)[1]
    normal, _ = estimate_normals(position, position[near[:, 1:]])
    return position, normal * np.where((normal * position).sum(axis=1, keepdims=True) < 0, -1, 1)


def surface_cells(path: str, iso: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Keys of the cells of a volume's surface, normals of their points, and seconds."""
    volume = open_volume(path)
    voxels = np.stack(list(volume.slices(print))).astype(np.float32)
    lattice = lattice_of(volume.shape, np.array(volume.directions), np.array(volume.origin), auto_size(volume.spacing))
    begun, found = time.perf_counter(), []
    for begin in range(0, lattice.counts[2], TASK):
        end = min(begin + TASK, lattice.counts[2])
        k0, k1 = lattice.voxel_slices(max(0, begin - HALO), min(lattice.counts[2], end + HALO), SUPPORT)
        values, first = sampled(voxels[k0:k1], k0, lattice, begin, end, "trilinear")
        found.append(surface_in(voxels[k0:k1], k0, values, first, lattice, begin, end, iso, "trilinear"))
    seconds = time.perf_counter() - begun
    gradient = np.concatenate([surface.gradient for surface in found])
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    normal = np.where(length > 0, -gradient / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
    return np.concatenate([surface.key for surface in found]), normal, seconds


if __name__ == "__main__":
    main()
