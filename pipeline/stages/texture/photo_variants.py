"""Photographs -> photographs as other codecs leave them; and what that costs the patches that are sampled from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.cameras.pinhole import resized
from pipeline.effects.exposure.photographs import read_photo
from pipeline.geometry.frame import Direction
from pipeline.numerics.accuracy import psnr_db
from pipeline.stages.texture.photo_codecs import CODECS, halved
from pipeline.stages.texture.resample import resampled_block
from pipeline.summaries import Photographs
from pipeline.texture.patches import texel_errors
from pipeline.texture.resample import PATCH_DIM, disc_weights
from storage.packed.schema import Camera
from storage.work import arrays, work

TILE = 512


@dataclass(frozen=True)
class VariantMade:
    """What photographs take in a codec, and their cameras at the size they then have."""

    bytes: int
    cameras: tuple[Camera, ...]


@dataclass(frozen=True)
class VariantMeasured:
    """What a codec costs the patches; None where it costs nothing."""

    texture_psnr_db: float | None
    visible_psnr_db: float | None


@dataclass(frozen=True)
class PhotoCoded:
    """What a task tells of its photograph."""

    bytes: int


@dataclass(frozen=True)
class PhotoVariant:
    """A task a photograph: `lod` times halved, encoded and decoded. Arrays photo_<i> (h, w, 3) uint8; its summary has
    the cameras at that size, so that its folder can stand for the ingest's where photographs are looked at."""

    ingest: Path
    lod: int
    codec: str
    bytes_per_pixel: float | None = None  # what each photograph may take, for codecs that know a budget
    name = "photo-variant"

    def init(self, folder: Path) -> int:
        for i, camera in enumerate(self._cameras()):
            shape = (camera.height_px, camera.width_px, 3)
            arrays.create(folder, f"photo_{i}", shape, "uint8", (TILE, TILE, 3))
        return len(self._cameras())

    def run(self, folder: Path, index: int) -> PhotoCoded:
        rgb = halved(read_photo(self.ingest, index), self.lod)
        budget = None if self.bytes_per_pixel is None else self.bytes_per_pixel * rgb.shape[0] * rgb.shape[1]
        decoded, n_bytes = CODECS[self.codec].coded(rgb, budget)
        arrays.write_picture(folder, f"photo_{index}", decoded)
        return PhotoCoded(bytes=n_bytes)

    def finalise(self, folder: Path, results: list[PhotoCoded]) -> VariantMade:
        return VariantMade(sum(r.bytes for r in results), tuple(self._cameras()))

    def _cameras(self) -> list[Camera]:
        return [camera_at(c, self.lod) for c in work.summary(self.ingest, Photographs).cameras]


def camera_at(camera: Camera, lod: int) -> Camera:
    """The camera of a photograph `lod` times halved."""
    width, height = camera.width_px, camera.height_px
    for _ in range(lod):
        width, height = max(1, width // 2), max(1, height // 2)
    return resized(camera, width, height)


@dataclass(frozen=True)
class BlockCompared:
    """What a task tells of its block: squared errors, and those weighted by what is visible."""

    n_splats: int
    squared_error: float
    weighted_error: float


@dataclass(frozen=True)
class VariantErrors:
    """A task a block: its patches from a variant of the photographs, against those from the photographs themselves."""

    variant: Path
    partition: Path
    splats: Path
    patches: Path
    radius: float
    up: Direction
    ahead: Direction
    name = "variant-errors"

    def init(self, folder: Path) -> int:
        return arrays.n_blocks(arrays.layout_of(self.patches, "energy").shape[0])

    def run(self, folder: Path, index: int) -> BlockCompared:
        start, stop = arrays.block_range(index, arrays.layout_of(self.patches, "energy").shape[0])
        found = resampled_block(self.variant, self.partition, self.splats, self.radius, self.up, self.ahead, index)
        squared, weighted = texel_errors(arrays.read(self.patches, "texel", start, stop), found.texel)
        return BlockCompared(n_splats=stop - start, squared_error=squared, weighted_error=weighted)

    def finalise(self, folder: Path, results: list[BlockCompared]) -> VariantMeasured:
        n, squared, weighted = (
            sum(getattr(r, k) for r in results) for k in ("n_splats", "squared_error", "weighted_error")
        )
        if not squared:  # the photographs as they are: there is nothing to state
            return VariantMeasured(None, None)
        visible = psnr_db(weighted, n * float(np.sum(disc_weights())))
        return VariantMeasured(psnr_db(squared, n * PATCH_DIM), visible)
