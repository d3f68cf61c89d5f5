"""What an effect may look at: the outputs of earlier stages, and one block of splats of them, read when first asked
for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from pipeline.geometry.frame import Direction, tangent_frames
from pipeline.splats.coarser import first_finest
from pipeline.splats.decoded import decoded_centres, decoded_normals, seen_by_cameras, splat_radii
from pipeline.summaries import Counted, Points, ScanRead
from storage.packed.schema import NO_CAMERA, Camera
from storage.work import arrays, work


@dataclass(frozen=True)
class Sources:
    """The folders that hold a scan as splats, and what all of them share."""

    ingest: Path
    partition: Path
    neighbours: Path
    depth_maps: Path | None
    splats: Path
    radius: float
    up: Direction
    ahead: Direction
    held_out: tuple[int, ...] = ()  # cameras whose photographs nothing is made from
    sizes: Path | None = None  # what sizes its splats need, whether or not they have them

    @cached_property
    def scan(self) -> ScanRead:
        return work.summary(self.ingest, ScanRead)

    @cached_property
    def used_sizes(self) -> Path | None:
        return self.sizes if arrays.exists(self.splats, "size_code") else None

    @cached_property
    def n_splats(self) -> int:
        return work.summary(self.splats, Counted).n_splats

    @cached_property
    def first_finest(self) -> int:
        """The first splat of the finest level; coarser ones stand before it."""
        return first_finest(work.summary(self.partition, Points))

    @cached_property
    def origin(self) -> np.ndarray:
        return np.array(work.summary(self.partition, Points).origin)

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        return self.scan.cameras

    def block(self, index: int, surveys: dict[str, Path] | None = None) -> Block:
        return Block(self, index, surveys or {})


@dataclass(frozen=True)
class Block:
    """Splats start..stop of a scan. Rows correspond; positions are against the scan's origin, directions unit."""

    sources: Sources
    index: int
    surveys: dict[str, Path]  # by effect: the folder of the survey that it asked for

    @property
    def rows(self) -> tuple[int, int]:
        return arrays.block_range(self.index, self.sources.n_splats)

    def read(self, folder: Path, name: str) -> np.ndarray:
        return arrays.read(folder, name, *self.rows)

    @cached_property
    def position(self) -> np.ndarray:  # (n, 3) float64, as scanned
        return self.read(self.sources.partition, "position")

    @cached_property
    def centre(self) -> np.ndarray:  # (n, 3) float64, as the renderer decodes it
        return decoded_centres(self.sources.splats, *self.rows)

    @cached_property
    def radius(self) -> np.ndarray:  # (n,) float64
        return splat_radii(self.sources.splats, self.sources.radius, *self.rows)

    @cached_property
    def frame(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Tangent u, tangent v and normal, (n, 3) float64 each, as the renderer decodes them."""
        return tangent_frames(decoded_normals(self.sources.splats, *self.rows), self.sources.up, self.sources.ahead)

    @cached_property
    def camera(self) -> np.ndarray:  # (n,) uint16, NO_CAMERA where there is none
        return self.read(self.sources.splats, "camera")

    @cached_property
    def has_camera(self) -> np.ndarray:  # (n,) bool
        return self.camera != NO_CAMERA

    @cached_property
    def station(self) -> np.ndarray:  # (n,) int64, -1 where there is none
        if not arrays.exists(self.sources.partition, "station"):
            return np.full(self.rows[1] - self.rows[0], -1)
        return self.read(self.sources.partition, "station").astype(np.int64)

    @cached_property
    def spacing(self) -> np.ndarray:  # (n,) float32: distance to the 4th neighbour
        return self.read(self.sources.neighbours, "spacing")

    @cached_property
    def seen(self) -> np.ndarray:  # (n, n_cameras) bool: which cameras see each splat, at most the 8 sharpest
        s = self.sources
        return seen_by_cameras(
            s.partition, s.depth_maps, s.cameras, self.centre + s.origin, self.frame[2], self.radius, *self.rows
        )

    def photo(self, camera: int, left: int, top: int, right: int, bottom: int) -> np.ndarray:
        """Pixels (h, w, 3) uint8 of a window of a photograph."""
        return arrays.read_window(self.sources.ingest, f"photo_{camera}", top, bottom, left, right)
