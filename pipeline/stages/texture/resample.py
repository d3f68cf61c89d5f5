"""Photographs -> patches, in the frame of the decoded geometry: kept, or measured and made again where they are
used."""

from __future__ import annotations

import threading
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pipeline.effects.exposure.photographs import read_photo_window
from pipeline.geometry.frame import Direction
from pipeline.numerics.accuracy import psnr_db
from pipeline.splats.coarser import first_finest
from pipeline.splats.decoded import decoded_squares
from pipeline.summaries import CoarserFirst, Counted, PatchesMade, Photographs, Points
from pipeline.texture.patches import Block, Patches, make_patches, patches_again
from pipeline.texture.resample import PATCH_DIM
from storage.work import arrays, work

AGAIN = "again.json"
_thread = threading.local()


@dataclass(frozen=True)
class BlockResampled:
    """What a task tells of its block."""

    n_splats: int
    resampling_error: float
    n_probes: int
    n_flagged: int
    energy: float


@dataclass(frozen=True)
class Resample:
    """A task a block. Arrays: texel (n, PATCH_DIM) uint8, average (n, 3) float32 in 255ths, energy (n,) float32, point
    (n,) int64 as the partition's.

    Not `kept`, there are no texels, 3 kB a splat, and no points: `texels` makes them again from the file AGAIN, in
    which this stage stands, and reads the partition's.
    """

    ingest: Path
    partition: Path
    splats: Path
    radius: float
    up: Direction
    ahead: Direction
    antialiased: bool = True
    kept: bool = True
    name = "resample"

    def init(self, folder: Path) -> int:
        n = work.summary(self.splats, Counted).n_splats
        if self.kept:
            arrays.create(folder, "texel", (n, PATCH_DIM), "uint8")
            arrays.create(folder, "point", (n,), "int64")
        else:
            work.write_json(folder / AGAIN, self._to_json())
        arrays.create(folder, "average", (n, 3), "float32")
        arrays.create(folder, "energy", (n,), "float32")
        return arrays.n_blocks(n)

    def run(self, folder: Path, index: int) -> BlockResampled:
        start, stop = arrays.block_range(index, work.summary(self.partition, Points).n_splats)
        sources = (self.ingest, self.partition, self.splats, self.radius, self.up, self.ahead, index)
        patches = resampled_block(*sources, self.antialiased, None if self.kept else block_memory())
        if self.kept:
            arrays.write(folder, "texel", start, patches.texel)
            arrays.write(folder, "point", start, arrays.read(self.partition, "point", start, stop))
        arrays.write(folder, "average", start, patches.average)
        arrays.write(folder, "energy", start, patches.energy)
        return BlockResampled(
            n_splats=stop - start,
            resampling_error=patches.resampling_error,
            n_probes=patches.n_probes,
            n_flagged=patches.n_flagged,
            energy=float(patches.energy.sum(dtype=np.float64)),
        )

    def finalise(self, folder: Path, results: list[BlockResampled]) -> PatchesMade:
        error, n_probes = (sum(getattr(r, k) for r in results) for k in ("resampling_error", "n_probes"))
        return PatchesMade(
            energy=sum(r.energy for r in results),
            n_flagged=sum(r.n_flagged for r in results),
            resampling_psnr_db=psnr_db(error, n_probes),
            n_coarser=first_finest(work.summary(self.partition, Points)),
        )

    def again(self, index: int, wanted: np.ndarray) -> np.ndarray:
        """Texels (m, PATCH_DIM) uint8 of the splats `wanted` (m,), ascending rows of block `index`; the process's
        memory, good until it makes others."""
        block = _block(self.ingest, self.partition, self.splats, self.radius, self.up, self.ahead, index)
        return patches_again(block, wanted, self.antialiased, block_memory())

    def _to_json(self) -> dict:
        """Folders by their names: all stand beside this stage's."""
        return {k: v.name if isinstance(v, Path) else v for k, v in asdict(self).items()}

    @staticmethod
    def of(folder: Path) -> Resample:
        """The stage whose folder this is, where it kept no texels."""
        told = work.read_json(folder / AGAIN)
        paths = {k: folder.parent / told[k] for k in ("ingest", "partition", "splats")}
        return Resample(**told | paths | {k: tuple(told[k]) for k in ("up", "ahead")})


def n_coarser_of(patches: Path) -> int:
    """How many of the patches, the first, are of coarser levels: whole groups. Nothing is learned or said of them."""
    return work.summary(patches, CoarserFirst).n_coarser


def resampled_block(
    photos: Path,
    partition: Path,
    splats: Path,
    radius: float,
    up: Direction,
    ahead: Direction,
    index: int,
    antialiased: bool = True,
    into: np.ndarray | None = None,
) -> Patches:
    """The patches of block `index`; `photos` is a folder of photographs, with their cameras in its summary."""
    start = index * arrays.BLOCK
    block = _block(photos, partition, splats, radius, up, ahead, index)
    return make_patches(block, start, antialiased, into)


def _block(
    photos: Path, partition: Path, splats: Path, radius: float, up: Direction, ahead: Direction, index: int
) -> Block:
    points = work.summary(partition, Points)
    start, stop = arrays.block_range(index, points.n_splats)
    centre, tangents, radii = decoded_squares(splats, up, ahead, radius, start, stop)

    def read_window(camera: int, left: int, top: int, right: int, bottom: int) -> np.ndarray:
        return read_photo_window(photos, camera, left, top, right, bottom)

    return Block(
        work.summary(photos, Photographs).cameras,
        read_window,
        points.origin,
        centre,
        tangents,
        radii,
        arrays.read(splats, "camera", start, stop),
        arrays.read(splats, "color", start, stop),
    )


def block_memory() -> np.ndarray:
    """(BLOCK, PATCH_DIM) uint8 of this thread, made once: new memory costs a process 8 us a patch, where a virtual
    machine must get it from its host."""
    if not hasattr(_thread, "memory"):
        _thread.memory = np.empty((arrays.BLOCK, PATCH_DIM), np.uint8)
    return _thread.memory
