"""Scan (reader) -> zarr: points in pieces, photographs decoded once."""

from __future__ import annotations

import functools
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pipeline.geometry.chunks import bounds
from pipeline.numerics.limits import check_bounds
from pipeline.readers import open_scan
from pipeline.readers.check import black_points
from pipeline.scan import Piece, ScanSource
from pipeline.splats.cameras import N_CANDIDATES, rank_candidates
from storage.errors import InvalidScan
from storage.work import arrays

PIECE = 1 << 16  # points a piece: 5 MB with everything that a point may carry
PHOTO_TILE = 512


@dataclass(frozen=True)
class Ingest:
    """Task 0 streams the points, task 1 + i decodes photograph i.

    Arrays: position (n, 3) float64 absolute; where the scan has them normal (n, 3) float32, color (n, 3) uint8,
    intensity (n,) float32, station (n,) int32, candidate (n, N_CANDIDATES) uint16; photo_<i> (h, w, 3) uint8.
    """

    scan_path: str
    fingerprint: str  # changes when the scan's files do
    name = "ingest"
    location_fields = ("scan_path",)

    def init(self, folder: Path) -> int:
        source = _source(self.scan_path, self.fingerprint)
        for i, camera in enumerate(source.cameras):
            shape = (camera.height_px, camera.width_px, 3)
            arrays.create(folder, f"photo_{i}", shape, "uint8", (PHOTO_TILE, PHOTO_TILE, 3))
        return 1 + len(source.cameras)

    def run(self, folder: Path, index: int) -> dict:
        source = _source(self.scan_path, self.fingerprint)
        if index == 0:
            return _store_points(source, folder)
        arrays.write_picture(folder, f"photo_{index - 1}", source.read_photo(index - 1))
        return {}

    def finalise(self, folder: Path, results: list[dict]) -> dict:
        source = _source(self.scan_path, self.fingerprint)
        points = results[0]
        warnings = list(source.warnings)
        if points["n_dropped"]:
            warnings.append(
                f"{points['n_dropped']} of {points['n_read']} points have a position that is not finite and were dropped"
            )
        warnings += black_points(source, points["n_splats"], **points["n_black"])
        return {
            "format": source.format,
            "unit": source.unit,
            "n_points": points["n_splats"],
            "n_read": points["n_read"],
            "n_dropped": points["n_dropped"],
            "low": points["low"],
            "high": points["high"],
            "intensity_range": points["intensity_range"],
            "cameras": [asdict(c) for c in source.cameras],
            "stations": source.stations,
            "has_visibility": source.has_visibility,
            "has_colors": source.has_colors or source.has_intensity,
            "warnings": warnings,
        }


@functools.lru_cache(maxsize=2)
def _source(scan_path: str, fingerprint: str) -> ScanSource:
    return open_scan(scan_path)


def _store_points(source: ScanSource, folder: Path) -> dict:
    writers: dict[str, arrays.Appender] = {}
    n_read = n_kept = 0
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    intensities, black = [], {"n_color": 0, "n_intensity": 0}
    for piece in source.pieces(PIECE):
        finite = np.isfinite(piece.position).all(axis=1)
        n_read += len(finite)
        columns = _columns(piece, finite, source)
        if not len(columns["position"]):
            continue
        n_kept += len(columns["position"])
        of_piece = bounds(columns["position"])
        low, high = np.minimum(low, of_piece[0]), np.maximum(high, of_piece[1])
        for name, rows in columns.items():
            if name not in writers:
                writers[name] = arrays.Appender(folder, name, rows.shape[1:], str(rows.dtype))
            writers[name].append(rows)
        if piece.colorless is not None:
            black["n_color"] += int(piece.colorless[finite].sum())
        if "intensity" in columns:
            black["n_intensity"] += int((~np.isfinite(columns["intensity"])).sum())
            known = columns["intensity"][np.isfinite(columns["intensity"])].astype(np.float64)
            if len(known):
                intensities.append(np.quantile(known, (0.01, 0.99)))
    for name, writer in writers.items():
        if writer.close() != n_kept:
            raise InvalidScan(source.path, f"only some of the points have {name}", "all points or none")
    if not n_kept:
        raise InvalidScan(source.path, f"none of its {n_read} points has a finite position", "at least one point")
    check_bounds(source.path, low, high)
    return {
        "n_splats": n_kept,
        "n_read": n_read,
        "n_dropped": n_read - n_kept,
        "n_black": black,
        "low": low.tolist(),
        "high": high.tolist(),
        "intensity_range": _intensity_range(intensities),
    }


def _columns(piece: Piece, keep: np.ndarray, source: ScanSource) -> dict[str, np.ndarray]:
    """The rows of a piece that are kept, by array name."""
    columns = {
        "position": piece.position,
        "normal": piece.normal,
        "color": piece.color,
        "intensity": piece.intensity,
        "station": piece.station,
    }
    columns = {name: rows[keep] for name, rows in columns.items() if rows is not None}
    if piece.visible_count is not None:
        seen_by = piece.visible_camera[np.repeat(keep, piece.visible_count)]
        columns["candidate"] = rank_candidates(
            columns["position"], columns.get("normal"), piece.visible_count[keep], seen_by, source.cameras
        )
        assert columns["candidate"].shape[1] == N_CANDIDATES
    return columns


def _intensity_range(quantiles: list[np.ndarray]) -> list[float] | None:
    """What black and white stand for: the widest 1 % and 99 % of any piece."""
    if not quantiles:
        return None  # no point has one, or none that is finite
    spread = np.array(quantiles, np.float64)
    return [float(spread[:, 0].min()), float(spread[:, 1].max())]
