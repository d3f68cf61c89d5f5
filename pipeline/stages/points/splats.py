"""Points -> splats: camera, colour, and quantised geometry."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.geometry.ellipsoids import encode_ellipsoids
from pipeline.geometry.frame import directions_of
from pipeline.geometry.normals import decode_normals, encode_normals
from pipeline.geometry.positions import decode_positions, encode_positions, fit_boxes
from pipeline.geometry.quadrics.codes import asked_steps
from pipeline.geometry.quadrics.frames import decode_quadrics
from pipeline.splats.cameras import best_cameras
from pipeline.splats.colors import point_colors
from pipeline.splats.decoded import read_sizes, seen_by_cameras, splat_radii
from pipeline.splats.normals import turned_to, usable_normals
from pipeline.splats.quadrics import quadrics_of_groups
from pipeline.stages.points.sizes import create_sizes, write_sizes
from pipeline.summaries import Points, ScanRead, Spacings, SplatsMade
from storage.packed.schema import BY_NAME, CHUNK, ELLIPSOID_FIELDS, FRAMES, NO_CAMERA
from storage.work import arrays, work

BOX_ARRAYS = ("box_low", "box_size", "box_bits")


@dataclass(frozen=True)
class SplatsBlock:
    """What a task tells of its block; errors are sums."""

    n_splats: int
    n_without_camera: int
    position_error: float
    normal_error: float  # degrees
    error_in_radii: float
    number_bits: int


@dataclass(frozen=True)
class Splats:
    """A task a block. Arrays by splat: position_code (n,) uint32, normal_code (n, 2) int8, camera (n,) uint16, color
    (n, 3) uint8; by chunk: box_low, box_size (c, 3) float32, box_bits (c, 3) uint8; of quadrics in the place of these
    number (n,) uint64, normal_point (n, 3) int16 and storage.packed.schema.FRAMES, of runs centre (n, 3) float32; with sizes size_code
    (n,), size_scale (c, 2) and size_cells (c,) uint8."""

    ingest: Path
    partition: Path
    neighbours: Path
    depth_maps: Path | None
    radius: float
    held_out: tuple[int, ...] = ()  # cameras that texture nothing
    ellipsoids: Path | None = None  # has_ellipsoid, centre and axes: these lie and look as their ellipsoids do
    sizes: Path | None = None  # size_code and size_scale: each splat has a radius of its own
    of_runs: bool = False  # the points are decoded cells of runs, in the place that they have in the file
    quadric_error: tuple[float, float] | None = None  # mean ones over quadrics, radii and degrees; None: in boxes
    name = "splats"

    def init(self, folder: Path) -> int:
        n = work.summary(self.partition, Points).n_splats
        for name, shape, dtype in (
            ("centre", (n, 3), "float32") if self.of_runs else self._coded(n),
            self._normals(n),
            ("camera", (n,), "uint16"),
            ("color", (n, 3), "uint8"),
        ):
            arrays.create(folder, name, shape, dtype)
        for name in () if self.of_runs else BOX_ARRAYS if self.quadric_error is None else FRAMES:
            width = tuple(int(dim) for dim in BY_NAME[name].dims[1:])
            arrays.create(folder, name, (-(-n // CHUNK), *width), BY_NAME[name].dtype, (arrays.BLOCK // CHUNK, *width))
        if self.quadric_error is not None:
            arrays.create(folder, "frame_box", (-(-n // CHUNK), 6), "float32", (arrays.BLOCK // CHUNK, 6))
        if self.sizes:
            create_sizes(folder, n)
        if self.ellipsoids:
            arrays.create(folder, "has_ellipsoid", (n,), "bool")
            arrays.create(folder, "ellipsoid", (n, ELLIPSOID_FIELDS), "uint8")
        return arrays.n_blocks(n)

    def _coded(self, n: int) -> tuple[str, tuple[int, ...], str]:
        return ("position_code", (n,), "uint32") if self.quadric_error is None else ("number", (n,), "uint64")

    def _normals(self, n: int) -> tuple[str, tuple[int, ...], str]:
        return ("normal_code", (n, 2), "int8") if self.quadric_error is None else ("normal_point", (n, 3), "int16")

    def run(self, folder: Path, index: int) -> SplatsBlock:
        scan, points = work.summary(self.ingest, ScanRead), work.summary(self.partition, Points)
        start, stop = arrays.block_range(index, points.n_splats)
        position = arrays.read(self.partition, "position", start, stop)
        absolute = position + points.origin
        normal = arrays.read(self.neighbours, "normal", start, stop).astype(np.float64)
        camera = self._cameras(scan, absolute, normal, start, stop)
        towards = self._towards_viewer(scan, absolute, normal, camera, start, stop)
        color = point_colors(scan, self.partition, turned_to(normal, towards), start, stop)
        scanned, bits = position, 0
        if self.ellipsoids:
            position = position.copy()
            self._take_ellipsoids(position, normal, start, stop)
        if self.of_runs:
            normal_code, centre = arrays.read(self.partition, "normal_code", start, stop), position
            for name, rows in (
                ("centre", position),
                ("normal_code", normal_code),
                ("camera", camera),
                ("color", color),
            ):
                arrays.write(folder, name, start, rows.astype(arrays.layout_of(folder, name).dtype))
        else:
            normal = turned_to(normal, towards)
            centre, normal_code, bits = self._write_geometry(folder, start, stop, position, normal)
            for name, rows in (("camera", camera), ("color", color)):
                arrays.write(folder, name, start, rows)
        if self.sizes:
            write_sizes(folder, start, *read_sizes(self.sizes, self.radius, start, stop))
        if self.ellipsoids:
            self._write_ellipsoids(folder, scan, normal_code, start, stop)
        # What is drawn against what was scanned: an ellipsoid's centre lies away from its point.
        off = np.linalg.norm(centre - scanned, axis=1)
        cosine = np.clip((decode_normals(normal_code) * normal).sum(axis=1), -1, 1)
        return SplatsBlock(
            n_splats=stop - start,
            n_without_camera=int((camera == NO_CAMERA).sum()),
            position_error=float(off.sum()),
            normal_error=float(np.degrees(np.arccos(cosine)).sum()),
            error_in_radii=float((off / self._radii(start, stop)).sum()),
            number_bits=bits,
        )

    def finalise(self, folder: Path, results: list[SplatsBlock]) -> SplatsMade:
        n = sum(r.n_splats for r in results)
        return SplatsMade(
            n_splats=n,
            n_without_camera=sum(r.n_without_camera for r in results),
            mean_position_error=sum(r.position_error for r in results) / n,
            mean_normal_error_degrees=sum(r.normal_error for r in results) / n,
            mean_error_in_radii=sum(r.error_in_radii for r in results) / n,
            number_bits=sum(r.number_bits for r in results) / n,
        )

    def _write_geometry(
        self, folder: Path, start: int, stop: int, position: np.ndarray, normal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Code positions (n, 3) and unit normals (n, 3). Returns them as they will be decoded, normals as codes or
        points, and the bits of all numbers of quadrics before they are sorted."""
        if self.quadric_error is not None:
            error, normal_error = self.quadric_error
            asked = asked_steps(self._radii(start, stop), error)
            sizes = self._sizes(start, stop)
            number, frames, of_chunks = quadrics_of_groups(position, normal, asked, normal_error, sizes)
            coded = "number", number
            decoded, normal_code = decode_quadrics(number, frames)
            bits = int(frames.bits[np.arange(stop - start) // CHUNK].sum())
        else:
            boxes = fit_boxes(position)
            coded = "position_code", encode_positions(position, boxes)
            of_chunks = dict(zip(BOX_ARRAYS, (boxes.low, boxes.size, boxes.bits)))
            decoded, normal_code, bits = decode_positions(coded[1], boxes), encode_normals(normal), 0
        arrays.write(folder, coded[0], start, coded[1])
        arrays.write(folder, self._normals(0)[0], start, normal_code)
        for name, rows in of_chunks.items():
            arrays.write(folder, name, start // CHUNK, rows)
        return decoded, normal_code, bits

    def _sizes(self, start: int, stop: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Codes (n,) and how many there are in each chunk (c,), where splats have sizes of their own."""
        if not self.sizes:
            return None
        code, scales = read_sizes(self.sizes, self.radius, start, stop)
        return code, scales.cells

    def _radii(self, start: int, stop: int) -> np.ndarray:
        return splat_radii(self.sizes, self.radius, start, stop)

    def _take_ellipsoids(self, position: np.ndarray, normal: np.ndarray, start: int, stop: int) -> None:
        """Move what is an ellipsoid to its centre, and let it look along its shortest axis."""
        has = arrays.read(self.ellipsoids, "has_ellipsoid", start, stop)
        shortest = arrays.read(self.ellipsoids, "axes", start, stop)[has, 2].astype(np.float64)
        position[has] = arrays.read(self.ellipsoids, "centre", start, stop)[has]
        normal[has] = shortest / np.linalg.norm(shortest, axis=1, keepdims=True)

    def _write_ellipsoids(self, folder: Path, scan: ScanRead, normal_code: np.ndarray, start: int, stop: int) -> None:
        has = arrays.read(self.ellipsoids, "has_ellipsoid", start, stop)
        fields = np.zeros((stop - start, ELLIPSOID_FIELDS), np.uint8)
        axes = arrays.read(self.ellipsoids, "axes", start, stop)[has].astype(np.float64)
        fields[has] = encode_ellipsoids(
            normal_code[has], *directions_of(scan.cameras), axes, self._radii(start, stop)[has]
        )
        arrays.write(folder, "has_ellipsoid", start, has)
        arrays.write(folder, "ellipsoid", start, fields)

    def _cameras(self, scan: ScanRead, absolute: np.ndarray, normal: np.ndarray, start: int, stop: int) -> np.ndarray:
        cameras = scan.cameras
        if not cameras:
            return np.full(len(absolute), NO_CAMERA, np.uint16)
        radii = self._radii(start, stop)
        seen = seen_by_cameras(self.partition, self.depth_maps, cameras, absolute, normal, radii, start, stop)
        seen[:, list(self.held_out)] = False
        return best_cameras(cameras, absolute, normal, radii, seen)

    def _towards_viewer(
        self, scan: ScanRead, absolute: np.ndarray, normal: np.ndarray, camera: np.ndarray, start: int, stop: int
    ) -> np.ndarray:
        """The directions (n, 3) that normals are turned to: the splat's camera; else the scan's own normal; else its
        station; else as neighbours settled it; else up (airborne scans), or away from the middle."""
        if work.summary(self.neighbours, Spacings).settled:
            towards = normal.copy()
        elif scan.format == "las":
            towards = np.tile([0.0, 0.0, 1.0], (len(absolute), 1))
        else:
            towards = absolute - (np.array(scan.low) + scan.high) / 2
        if arrays.exists(self.partition, "station"):
            station = arrays.read(self.partition, "station", start, stop)
            seen = station >= 0  # what was merged from several has none
            towards[seen] = np.array(scan.stations)[station[seen]] - absolute[seen]
        has = camera != NO_CAMERA
        if arrays.exists(self.partition, "normal"):
            blind = np.flatnonzero(~has)  # of others it makes no difference whether they had a normal
            missing = usable_normals(arrays.read_rows(self.partition, "normal", start + blind))[1]
            towards[blind[~missing]] = normal[blind[~missing]]
        if scan.cameras:
            towards[has] = np.array([c.centre for c in scan.cameras])[camera[has]] - absolute[has]
        return towards
