"""Packed file + photographs -> what the file has lost, measured on its own bytes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.coding.grid import shown, transformed_texels
from pipeline.coding.omp_kernels import add_atoms
from pipeline.coding.quantise import dequantise_atoms
from pipeline.effects.exposure.photographs import read_photo_window
from pipeline.effects.plan.request import OFF, asked_by
from pipeline.geometry.ellipsoids import decode_ellipsoids, squares_of
from pipeline.geometry.frame import tangent_frames
from pipeline.numerics.accuracy import psnr_db
from pipeline.splats.decoded import scene_normal_codes, scene_positions, scene_radii
from pipeline.stages.texture.encode import ROWS, BlockCoded, coding_quality
from pipeline.summaries import Photographs
from pipeline.texture.colors import ColorBoxes, decode_colors
from pipeline.texture.patches import Block, Patches, make_patches, patch_errors
from pipeline.texture.resample import PATCH_DIM
from storage.packed.packed import PackedFile, PackedScene
from storage.packed.schema import GROUP
from storage.work import work


@dataclass(frozen=True)
class FileMeasured:
    """What a packed file shows of its photographs."""

    texture_psnr_db: float | None
    visible_psnr_db: float | None
    histogram: tuple[int, ...]
    mean_atoms: float
    resampling_psnr_db: float | None
    n_flagged: int


@dataclass(frozen=True)
class GroupMeasured:
    """What a task tells of its group: errors of coding, and of resampling by probes."""

    n_splats: int
    coded: BlockCoded
    resampling_error: float
    n_probes: int
    n_flagged: int


@dataclass(frozen=True)
class Measure:
    """A task a group: its patches are resampled from the photographs and compared with what the file decodes to; splats
    without a camera count as exact, for the file has all that is known of their colour."""

    ingest: Path  # of the scan that has the photographs of the file's cameras, in the same order
    packed: Path
    digest: str
    name = "measure"
    location_fields = ("packed",)

    def init(self, folder: Path) -> int:
        with PackedFile(self.packed) as packed:
            return packed.header.n_groups

    def run(self, folder: Path, index: int) -> GroupMeasured:
        with PackedFile(self.packed, verify=False) as packed:
            scene, coarser = packed.group(index), index * GROUP < packed.header.first_finest
            atoms, levels = decoded_atoms(packed)
        patches = self._resample(scene, index * GROUP)
        texel = patches.texel
        color = decoded_colors(scene)
        squared, weighted = 0.0, 0.0
        for at in range(0, len(texel), ROWS):
            if coarser:
                break
            rows = slice(at, min(at + ROWS, len(texel)))
            lost = patch_errors(texel[rows], color[rows], decode_patches(scene, rows, atoms, levels))
            squared, weighted = squared + lost[0], weighted + lost[1]
        return GroupMeasured(
            n_splats=len(texel),
            coded=BlockCoded(
                n_splats=len(texel),
                n_measured=0 if coarser else len(texel),
                squared_error=squared,
                weighted_error=weighted,
                histogram=np.bincount(scene.n_atoms, minlength=scene.header.n_ranks + 1).tolist(),
            ),
            resampling_error=patches.resampling_error,
            n_probes=patches.n_probes,
            n_flagged=patches.n_flagged,
        )

    def finalise(self, folder: Path, results: list[GroupMeasured]) -> FileMeasured:
        error, n_probes = (sum(getattr(r, k) for r in results) for k in ("resampling_error", "n_probes"))
        return FileMeasured(
            **vars(coding_quality([r.coded for r in results])),
            resampling_psnr_db=psnr_db(error, n_probes),
            n_flagged=sum(r.n_flagged for r in results),
        )

    def _resample(self, scene: PackedScene, first_splat: int) -> Patches:
        header, a = scene.header, scene.arrays
        centre, tangents = scene_squares(scene)
        block = Block(
            header.cameras,
            self._read_window,
            header.origin,
            centre,
            tangents,
            scene_radii(scene),
            a["camera"],
            np.rint(decoded_colors(scene)).astype(np.uint8),
        )
        return make_patches(block, first_splat, asked_by(header.settings)["antialiasing"] != OFF)

    def _read_window(self, camera: int, left: int, top: int, right: int, bottom: int) -> np.ndarray:
        return read_photo_window(self.ingest, camera, left, top, right, bottom)


@dataclass(frozen=True)
class SplatErrors:
    """Splats of a packed file: where they are, who photographed them, and what coding lost."""

    centre: np.ndarray  # (n, 3) float64 absolute
    camera: np.ndarray  # (n,) uint16
    error: np.ndarray  # (n,) mean squared error
    plain: np.ndarray  # (n,) that of the average colour alone


def splat_errors(ingest: Path, packed: Path, index: int) -> SplatErrors:
    """Those of group `index` of a packed file."""
    with PackedFile(packed, verify=False) as opened:
        scene = opened.group(index)
        atoms, levels = decoded_atoms(opened)
    texel = Measure(ingest, packed, "")._resample(scene, index * GROUP).texel
    color, error, plain = decoded_colors(scene), np.empty(len(texel)), np.empty(len(texel))
    for at in range(0, len(texel), ROWS):
        rows = slice(at, min(at + ROWS, len(texel)))
        wanted = texel[rows].astype(np.float32) / 255
        mean = np.tile(color[rows], PATCH_DIM // 3) / 255
        plain[rows] = ((mean - wanted) ** 2).mean(axis=1)
        error[rows] = (((mean + decode_patches(scene, rows, atoms, levels)).clip(0, 1) - wanted) ** 2).mean(axis=1)
    return SplatErrors(scene_positions(scene) + scene.header.origin, scene.arrays["camera"], error, plain)


def scene_squares(scene: PackedScene) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Middles and tangents of the squares that the splats of a scene are textured on, all (n, 3)."""
    header, normal_code = scene.header, scene_normal_codes(scene)
    centre, (u, v, _) = scene_positions(scene), tangent_frames(normal_code, header.up, header.ahead)
    has, fields = scene.ellipsoids
    radius = scene_radii(scene)[has]
    axes = decode_ellipsoids(fields, normal_code[has], header.up, header.ahead, radius)
    centre, u, v = squares_of(centre, u, v, has, axes, radius)
    return centre, (u, v)


def decoded_colors(scene: PackedScene) -> np.ndarray:
    """Average colours, (n, 3) float32 in 255ths."""
    arrays = scene.arrays
    if not scene.header.color_step:
        return arrays["color"].astype(np.float32)
    return decode_colors(scene.color_cells, ColorBoxes.of_arrays(arrays, scene.header.color_step))


def decoded_atoms(packed: PackedFile) -> tuple[np.ndarray, np.ndarray]:
    """Texels (n_indices, 3 atom_size^2) float32 of what each index of a packed file names, and its weight levels."""
    header = packed.header
    if not header.n_dictionary:
        return np.zeros((1, PATCH_DIM), np.float32), np.zeros((header.n_ranks, 1), np.float32)
    size = header.atom_size
    texels = packed.read(f"atoms_{size}").reshape(-1, size, size, 3)
    turned = np.stack([transformed_texels(texels, turn) for turn in range(header.n_turns)], axis=1)
    scale = np.repeat(packed.read("atom_scale"), header.n_turns)
    return dequantise_atoms(turned.reshape(header.n_indices, -1), scale), packed.read("weight_levels")


def decode_patches(scene: PackedScene, rows: slice, atoms: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """What the atoms of some splats add to their averages, (n, PATCH_DIM) float32."""
    atom, code = scene.codes(rows.start, rows.stop)
    decoded = np.zeros((len(atom), atoms.shape[1]), np.float32)
    add_atoms(decoded, atoms, atom, levels[np.arange(len(levels)), code], scene.n_atoms[rows])
    return shown(decoded, scene.header.atom_size)


def ingest_fits(ingest: Path, packed_names: list[str]) -> bool:
    """Whether a scan's photographs are those a packed file was made from, by name and order."""
    return [camera.name for camera in work.summary(ingest, Photographs).cameras] == packed_names
