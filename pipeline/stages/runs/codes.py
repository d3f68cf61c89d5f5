"""Runs of cells -> their codes, brick by brick, and what these decode to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.geometry.normals import decode_normals
from pipeline.geometry.runs.codes import decode_runs, encode_runs, positions_of, turned
from pipeline.geometry.runs.normals import N_STEPS
from pipeline.geometry.runs.starts import SECTION_WORDS, pack_starts
from pipeline.geometry.runs.walks import Runs
from pipeline.stages.runs.found import CellsFilled, GridFound, RunsCoded
from storage.work import arrays, work


@dataclass(frozen=True)
class BrickCoded:
    """What a task tells of its brick."""

    n_splats: int
    n_runs: int
    n_sections: int
    place_bits: int  # of all starts on a graphics card
    start_normal_bits: int
    normal_error: float  # degrees, summed


@dataclass(frozen=True)
class RunCoding:
    """A task a brick. Arrays by brick i: run_base_i, run_first_i, run_start_i, run_normal_i and run_step_i as the
    packed file has them, counted from the brick; by cell in the order of the file position_i (m, 3) float32,
    normal_code_i (m, 2) int8, point_i (m,) int64."""

    cells: Path
    grid: Path
    name = "runs"

    def init(self, folder: Path) -> int:
        return len(work.summary(self.cells, CellsFilled).first_cell) - 1

    def run(self, folder: Path, index: int) -> BrickCoded:
        first, end = work.summary(self.cells, CellsFilled).first_cell[index : index + 2]
        if first == end:
            return BrickCoded(n_splats=0, n_runs=0, n_sections=0, place_bits=0, start_normal_bits=0, normal_error=0.0)
        key, normal, point, cells, start = (
            arrays.read(self.cells, f"{name}_{index}") for name in ("key", "normal", "point", "cell", "start")
        )
        normal = normal.astype(np.float64)
        book = arrays.read(self.cells, "codebook")
        codes, place = encode_runs(key, normal, Runs(cells, start), book, first)
        cell_index, normal_code = decode_runs(codes)
        grid = work.summary(self.grid, GridFound)
        rows = {
            "run_base": codes.base,
            "run_first": codes.first_run,
            "run_start": codes.start,
            "run_normal": codes.normal,
            "run_step": codes.step,
            "position": turned(positions_of(cell_index, grid.cell), grid.turn),
            "normal_code": normal_code,
            "point": point[place],
        }
        for name, values in rows.items():
            arrays.store(folder, f"{name}_{index}", values)
        starts = pack_starts(codes)
        cosine = np.clip((decode_normals(normal_code) * normal[place]).sum(axis=1), -1, 1)
        return BrickCoded(
            n_splats=len(place),
            n_runs=len(codes.start),
            n_sections=len(codes.base),
            place_bits=starts.place_bits,
            start_normal_bits=starts.normal_bits,
            normal_error=float(np.degrees(np.arccos(cosine)).sum()),
        )

    def finalise(self, folder: Path, results: list[BrickCoded]) -> RunsCoded:
        n_cells, n_runs, n_sections, place_bits, start_normal_bits = (
            sum(getattr(r, k) for r in results)
            for k in ("n_splats", "n_runs", "n_sections", "place_bits", "start_normal_bits")
        )
        tables = 32 * SECTION_WORDS * (n_sections + 1) + 64 + 8 * 2 * N_STEPS
        return RunsCoded(
            n_splats=n_cells,
            n_runs=n_runs,
            n_sections=n_sections,
            start_bits=(place_bits + tables) / n_cells,
            steps_bits=3 * (n_cells - n_runs) / n_cells,
            normals_bits=(start_normal_bits + 5 * (n_cells - n_runs)) / n_cells,
            mean_normal_error_degrees=sum(r.normal_error for r in results) / n_cells,
            mean_length=n_cells / n_runs,
        )


def brick_rows(codes: Path, cells: Path, name: str, start: int, stop: int) -> np.ndarray:
    """Rows start..stop of what `RunCoding` has by cell, in the order of the file."""
    first = work.summary(cells, CellsFilled).first_cell
    parts = [
        arrays.read(codes, f"{name}_{i}", max(0, start - first[i]), min(stop, first[i + 1]) - first[i])
        for i in range(len(first) - 1)
        if first[i] < stop and first[i + 1] > start and first[i] < first[i + 1]
    ]
    return np.concatenate(parts)
