"""What the stages of runs tell each other, and the report."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.summaries import Vector


@dataclass(frozen=True)
class GridFound:
    """Of the grid of runs. `efficiency` and bits are those of the sample."""

    n_splats: int
    cell: float
    turn: tuple[float, ...]  # (9,) rows of the matrix from the grid's axes to the scan's
    hit_rate: float
    efficiency: float
    spacing: float  # mean distance of points to the nearest
    gpu_bits_a_point: float


@dataclass(frozen=True)
class CellsFilled:
    """Of the cells of all bricks. Errors are distances of points to the centres of their cells."""

    n_splats: int  # points
    n_cells: int
    n_added: int  # that close gaps
    n_decoded: int
    first_cell: tuple[int, ...]  # of each brick in the file, and the end
    max_error: float
    mean_error: float
    hit_rate: float


@dataclass(frozen=True)
class RunsCoded:
    """Of the codes of all bricks. Bits are those of a splat on a graphics card."""

    n_splats: int
    n_runs: int
    n_sections: int
    start_bits: float
    steps_bits: float
    normals_bits: float
    mean_normal_error_degrees: float
    mean_length: float


@dataclass(frozen=True)
class CellsAsPoints:
    """Of decoded cells: what points in chunk order tell, and neighbourhoods."""

    n_splats: int
    origin: Vector
    levels: tuple[int, ...]
    median_spacing: float | None
    n_degenerate: int
    settled: bool = False
