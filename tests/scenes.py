"""Tiny packed scenes from plain arrays, for tests."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.geometry.chunks import median_split
from pipeline.geometry.cliplines import encode_cliplines
from pipeline.geometry.ellipsoids import encode_ellipsoids
from pipeline.geometry.normals import encode_normals
from pipeline.geometry.positions import encode_positions, fit_boxes
from pipeline.geometry.quadrics.codes import asked_steps
from pipeline.geometry.sizes import encode_sizes, fit_scales
from pipeline.splats.quadrics import quadrics_of_groups
from pipeline.texture.colors import encode_colors, fit_color_boxes
from storage.packed.batches import CHUNKS_PER_GROUP, count_batches, rows_of
from storage.packed.bits import pack_bits, pack_sizes
from storage.packed.codes import pack_codes
from storage.packed.colors import pack_colors
from storage.packed.packed import PackedScene
from storage.packed.quadrics import number_starts, pack_numbers
from storage.packed.schema import (
    BOXES,
    CHUNK,
    CLIPLINE_BITS,
    FORMS,
    GROUP,
    MAX_ATOMS,
    MIP_SIZES,
    NO_CAMERA,
    QUADRICS,
    Batch,
    Camera,
    Header,
)


@dataclass(frozen=True)
class Splats:
    """What a tiny scene is made of, in any order. Rows correspond; what is None is the plainest there is."""

    position: np.ndarray  # (n, 3) float64, absolute
    normal: np.ndarray  # (n, 3) unit
    color: np.ndarray | None = None  # (n, 3) uint8; grey
    n_atoms: np.ndarray | None = None  # (n,) 0..16; none
    atom: np.ndarray | None = None  # (n, r) index
    weight: np.ndarray | None = None  # (n, r) weight code
    clipline: np.ndarray | None = None  # (n, 3) a, b, c; NaN where there is none
    camera: np.ndarray | None = None  # (n,) index; none
    axes: np.ndarray | None = (
        None  # (n, 3, 3) half axes of ellipsoids as rows, the third along the normal; NaN where it is a disc
    )
    size: np.ndarray | None = None  # (n,) radii; the one of the settings


@dataclass(frozen=True)
class Dictionary:
    """Atoms and weights; `atoms` are texels of the finest level, and the mip levels are their means."""

    atoms: np.ndarray  # (k, s, s, 3) int8, -127..127; s is 32, 16 or 8
    scale: np.ndarray  # (k,) float32
    weight_levels: np.ndarray  # (n_ranks, 2^weight_bits) float32
    dictionary_bits: int = 8
    n_turns: int = 1


@dataclass(frozen=True)
class Settings:
    radius: float = 0.1
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: tuple[int, int, int] = (0, 0, 1)
    ahead: tuple[int, int, int] = (1, 0, 0)
    depth_margin: float = 0.05
    cameras: tuple[Camera, ...] = field(default=())
    size_bits: int = 3  # where splats have sizes of their own
    color_step: int = 0  # 0: colours in whole bytes, else in boxes
    quadric_error: float | None = None  # of quadrics, in radii; None: in boxes


def random_colors(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.integers(20, 236, (n, 3)).astype(np.uint8)


def sheet(rng: np.random.Generator, n: int, tilt: float = 0.3, half_width: float = 0.5, **more) -> Splats:
    """Splats scattered over the square |x|, |z| <= half_width of the plane y = 0, their normals tilted at random."""
    position = rng.uniform(-half_width, half_width, (n, 3)) * [1, 0, 1]
    normal = np.array([0.0, -1.0, 0.0]) + rng.normal(0, tilt, (n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Splats(position, normal, random_colors(rng, n), **more)


def coded(rng: np.random.Generator, n: int, n_dictionary: int = 20, weight_bits: int = 4, max_atoms: int = 8) -> dict:
    """Random codes, as arguments of `Splats`."""
    return {
        "n_atoms": rng.integers(0, max_atoms + 1, n),
        "atom": rng.integers(0, n_dictionary, (n, max_atoms)),
        "weight": rng.integers(0, 2**weight_bits, (n, max_atoms)),
    }


def random_dictionary(rng: np.random.Generator, n_atoms: int = 20, weight_bits: int = 4, bits: int = 8) -> Dictionary:
    """Smooth random atoms and even weight levels."""
    y, x = np.meshgrid(np.linspace(-1, 1, 32), np.linspace(-1, 1, 32), indexing="ij")
    angle, cycles = rng.uniform(0, 2 * np.pi, n_atoms), rng.uniform(0.5, 3, n_atoms)
    shift = rng.uniform(0, 6, (n_atoms, 3))
    across = np.cos(angle)[:, None, None] * x + np.sin(angle)[:, None, None] * y
    waves = np.sin(np.pi * cycles[:, None, None] * across)[..., None] * np.cos(shift)[:, None, None, :]
    atoms = np.clip(np.round(waves * 127), -127, 127).astype(np.int8)
    levels = np.tile(np.linspace(-1, 1, 2**weight_bits), (MAX_ATOMS, 1)) / np.arange(1, MAX_ATOMS + 1)[:, None]
    return Dictionary(atoms, np.full(n_atoms, 0.2 / 127, np.float32), levels.astype(np.float32), bits)


def mip_levels(atoms: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays atoms_s .. atoms_1 of atoms (k, s, s, 3) int8: each level the mean of the one before."""
    level, arrays = atoms.astype(np.float64), {}
    for size in MIP_SIZES[MIP_SIZES.index(atoms.shape[1]) :]:
        arrays[f"atoms_{size}"] = np.round(level).astype(np.int8)
        if size > 1:
            level = level.reshape(len(level), size // 2, 2, size // 2, 2, 3).mean(axis=(2, 4))
    return arrays


def build_scene(splats: Splats, settings: Settings = Settings(), dictionary: Dictionary | None = None) -> PackedScene:
    """The packed scene of these splats: split into chunks and, inside each, sorted by batch."""
    scene, _ = build_scene_and_order(splats, settings, dictionary)
    return scene


def build_scene_and_order(
    splats: Splats, settings: Settings = Settings(), dictionary: Dictionary | None = None
) -> tuple[PackedScene, np.ndarray]:
    """The scene, and which of the given splats stands at each place of it."""
    n = len(splats.position)
    n_atoms = np.zeros(n, int) if splats.n_atoms is None else np.asarray(splats.n_atoms)
    line = np.full((n, 3), np.nan) if splats.clipline is None else splats.clipline
    axes = np.full((n, 3, 3), np.nan) if splats.axes is None else splats.axes
    flags = (~np.isnan(line[:, 0])).tolist(), (~np.isnan(axes[:, 0, 0])).tolist()
    kind_of = list(zip(n_atoms.tolist(), *flags, strict=True))
    kinds = sorted(set(kind_of), key=lambda kind: kind[::-1])
    batches = tuple(Batch(*kind) for kind in kinds)
    batch = np.array([kinds.index(kind) for kind in kind_of])

    local = np.asarray(splats.position, np.float64) - settings.origin
    order = median_split(local)
    keys = [batch[order], np.arange(n) // CHUNK]
    if settings.quadric_error:
        radii = (np.full(n, settings.radius) if splats.size is None else splats.size)[order]
        asked = asked_steps(radii, settings.quadric_error)
        sizes = None
        if splats.size is not None:
            scales = fit_scales(splats.size[order], settings.radius, None)
            sizes = encode_sizes(splats.size[order], scales), scales.cells
        number, _, frames = quadrics_of_groups(local[order], splats.normal[order], asked, sizes=sizes)
        keys = [number, *keys]
    sorted_ = np.lexsort(keys)
    order = order[sorted_]
    batch, line, n_atoms, axes = batch[order], line[order], n_atoms[order], axes[order]

    header = Header(
        n_splats=n,
        radius=settings.radius,
        unit="metre",
        origin=settings.origin,
        up=settings.up,
        ahead=settings.ahead,
        margin_radii=settings.depth_margin / settings.radius,
        size_bits=0 if splats.size is None else 4 if settings.quadric_error else settings.size_bits,
        n_dictionary=len(dictionary.atoms) if dictionary else 0,
        dictionary_bits=dictionary.dictionary_bits if dictionary else 8,
        weight_bits=dictionary.weight_levels.shape[1].bit_length() - 1 if dictionary else 4,
        batches=batches,
        cameras=settings.cameras,
        scan={},
        settings={},
        color_step=settings.color_step,
        geometry=QUADRICS if settings.quadric_error else BOXES,
        **(
            {
                "atom_size": dictionary.atoms.shape[1],
                "n_turns": dictionary.n_turns,
                "n_ranks": len(dictionary.weight_levels),
            }
            if dictionary
            else {}
        ),
    )
    boxes = fit_boxes(local[order])
    position = encode_positions(local[order], boxes).astype("<u4").view(np.uint8).reshape(n, 4)[:, :3]
    color = np.full((n, 3), 128, np.uint8) if splats.color is None else splats.color
    arrays = {
        "box_low": boxes.low,
        "box_size": boxes.size,
        "box_bits": boxes.bits,
        "position": position.copy(),
        "normal": encode_normals(splats.normal[order]),
        "batch_count": count_batches(batch, len(batches)),
    }
    normal_code = arrays["normal"]
    if settings.quadric_error:
        arrays = {name: values for name, values in arrays.items() if name not in FORMS}
        arrays |= _quadrics(number[sorted_], frames, arrays["batch_count"])
    if header.size_bits and settings.quadric_error:
        arrays["size_scale"] = scales.step
    elif header.size_bits:
        scales = fit_scales(splats.size[order], settings.radius, header.size_bits)
        codes = encode_sizes(splats.size[order], scales)
        arrays |= {"size_scale": scales.step, "sizes": pack_sizes(codes, header.size_bits)}
    arrays |= color_boxes(color[order], settings.color_step) if settings.color_step else {"color": color[order]}
    rows = rows_of(arrays["batch_count"], batches)
    groups = [slice(start, start + GROUP) for start in range(0, n, GROUP)]
    if dictionary:
        atom, weight = splats.atom[order], splats.weight[order]
        streams = [pack_codes(header, rows.entry[g], n_atoms[g], atom[g], weight[g]) for g in groups]
        arrays["codes"], arrays["group_word"] = _joined(streams)
        arrays |= mip_levels(dictionary.atoms)
        arrays |= {"atom_scale": dictionary.scale, "weight_levels": dictionary.weight_levels}
    if any(kind.clipline for kind in batches):
        codes = encode_cliplines(np.nan_to_num(line))
        streams = [pack_bits(_in_row_order(codes[g], rows.clipline[g]), CLIPLINE_BITS) for g in groups]
        arrays["cliplines"], arrays["clipline_word"] = _joined(streams)
    if any(kind.ellipsoid for kind in batches):
        fields = encode_ellipsoids(normal_code, header.up, header.ahead, np.nan_to_num(axes, nan=1.0), settings.radius)
        words = fields.view("<u4")[:, 0]
        streams = [_in_row_order(words[g], rows.extra["ellipsoid"][g]) for g in groups]
        arrays["ellipsoids"], arrays["ellipsoid_word"] = _joined(streams)
    if settings.cameras:
        camera = np.full(n, NO_CAMERA) if splats.camera is None else splats.camera
        arrays["camera"] = camera[order].astype(np.uint16)
    assert len(arrays["batch_count"]) == -(-n // CHUNK) and len(groups) == -(-n // (CHUNK * CHUNKS_PER_GROUP))
    return PackedScene(header, arrays), order


def _quadrics(number: np.ndarray, frames: dict[str, np.ndarray], batch_count: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of splats over quadrics, of numbers (n,) in the order of the file."""
    bits = frames["frame_bits"]
    _, words = number_starts(batch_count, bits)
    stream = np.append(pack_numbers(number, batch_count, bits), np.uint32(0))
    return frames | {"splats": stream, "splat_word": (words.cumsum() - words).astype(np.uint32)}


def color_boxes(color: np.ndarray, step: int) -> dict[str, np.ndarray]:
    """Colours (n, 3) as the arrays that hold them in boxes."""
    boxes = fit_color_boxes(color, step)
    stream, first = _joined(pack_colors(encode_colors(color, boxes), boxes.bits.sum(axis=1)))
    return boxes.arrays() | {"colors": stream, "color_word": first}


def _joined(streams: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """One stream with its spare word, and the first word of each part."""
    lengths = np.array([len(stream) for stream in streams])
    first = (lengths.cumsum() - lengths).astype(np.uint32)
    return np.concatenate([*streams, np.zeros(1, np.uint32)]).astype(np.uint32), first


def _in_row_order(code: np.ndarray, row: np.ndarray) -> np.ndarray:
    has_line = row >= 0
    result = np.zeros(int(has_line.sum()), np.uint32)
    result[row[has_line]] = code[has_line]
    return result


def camera_looking(
    centre,
    target,
    size: tuple[int, int] = (64, 48),
    focal_px: tuple[float, float] = (60.0, 60.0),
    up=(0.0, 0.0, 1.0),
    name: str = "view",
) -> Camera:
    """A camera at `centre` that looks at `target`, its principal point a little off the middle."""
    forward = np.subtract(target, centre, dtype=float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(
        name,
        *size,
        *focal_px,
        size[0] * 0.52,
        size[1] * 0.47,
        tuple(map(tuple, rotation.tolist())),
        tuple(float(x) for x in centre),
    )
