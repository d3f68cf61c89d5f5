"""Quadrics: what comes back, of surfaces and of what is none."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.chunks import median_split
from pipeline.geometry.normals import decode_normals
from pipeline.geometry.quadrics.codes import asked_steps, encode_quadrics
from pipeline.geometry.quadrics.frames import Frames, decode_quadrics, frames_of_arrays, named_frames
from pipeline.geometry.quadrics.quaternions import axes_of
from pipeline.splats.quadrics import quadrics_of_groups
from storage.packed.quadrics import check_numbers, number_starts, pack_numbers, unpack_numbers
from storage.packed.schema import CHUNK, GROUP, MOST_FRAME_CELLS, frame_origins, normal_steps, steps_of


def unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def cases() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(0)
    flat = rng.uniform(-1, 1, (300, 3)) * [1, 0.4, 0]
    bowl = rng.uniform(-1, 1, (256, 3))
    bowl[:, 2] = 0.4 * bowl[:, 0] ** 2 - 0.2 * bowl[:, 0] * bowl[:, 1]
    slope = np.stack([0.2 * bowl[:, 1] - 0.8 * bowl[:, 0], 0.2 * bowl[:, 0], np.ones(256)], axis=1)
    up = np.tile([0.0, 0, 1], (300, 1))
    return {
        "a plane": (flat, up),
        "a bowl": (bowl, unit(slope)),
        "looking down": (bowl, unit(slope * [1, 1, -1] + [0.01, 0, 0])),
        "all round": (rng.standard_normal((200, 3)), unit(rng.standard_normal((200, 3)))),
        "one point": (np.tile([3.0, -2, 1], (130, 1)), up[:130]),
        "one splat": (np.array([[1e5, 2e5, -3e5]]), up[:1]),
        "a line": (np.linspace(0, 1, 128)[:, None] * [1.0, 2, 3], up[:128]),
        "an outlier": (np.concatenate([flat[:127], [[1e4, 0, 0]]]), up[:128]),
        "far away": (flat + [4e6, -3e6, 2e6], up),
        "a thin sheet of two sides": (
            flat * [1, 1, 0] + [[0, 0, 1e-3]] * 300,
            up * np.where(np.arange(300) % 2, 1, -1)[:, None],
        ),
    }


def asked(position: np.ndarray, step: float = 0.01) -> np.ndarray:
    return np.full(-(-len(position) // CHUNK), step)


@pytest.mark.parametrize("name", cases())
def test_quadrics__positions_come_back_within_half_a_cell_and_normals_on_their_chunks_map(name):
    position, normal = cases()[name]
    values = 1 + np.arange(-(-len(position) // CHUNK), dtype=np.uint8) * 15
    size = np.arange(len(position)) % values[np.arange(len(position)) // CHUNK]
    number, frames, named = quadrics_of_groups(position, normal, asked(position), sizes=(size, values))
    assert (frame_origins(named) == frames.origin).all()
    found, point = decode_quadrics(number, frames)
    assert (number % values[np.arange(len(position)) // CHUNK] == size).all()
    assert number.dtype == np.uint64 and len(number) == len(position)
    steps = normal_steps(frames.normal_grid)[np.arange(len(position)) // CHUNK]
    assert (np.abs(point).sum(axis=1) == steps).all()
    off = np.degrees(np.arccos(np.clip((decode_normals(point) * normal).sum(axis=1), -1, 1)))
    assert (off <= 0.64 * 127 / steps).all() and off.mean() < 0.35
    chunk = np.arange(len(position)) // CHUNK
    step = steps_of(frames.step)[chunk]
    off = np.einsum("nij,nj->ni", axes_of(frames.turn)[chunk], found - position)
    rounding = np.spacing(np.abs(position).max())
    assert (np.abs(off) <= (0.5 + 1e-6) * step[:, None] + 2 * rounding).all()
    span = np.ptp(position, axis=0).max()
    widest = max(1.13 * 0.01, 1.1 * span / MOST_FRAME_CELLS, 2**-21 * np.abs(position).max())
    assert step.max() <= (widest if name != "all round" else 1.11 * 0.08)  # of which 2^31 cells fill the box
    scale = np.stack([0 * values, (values - 1.0) * 1.875], axis=1).astype(np.uint8)
    check_numbers(arrays_of(number, frames) | {"size_scale": scale})


def arrays_of(number: np.ndarray, frames: Frames, n_batches: int = 1) -> dict[str, np.ndarray]:
    """As a file holds them, its splats in batches of as many in each chunk."""
    n = np.minimum(CHUNK, len(number) - CHUNK * np.arange(len(frames.bits)))
    ends = np.arange(1, n_batches + 1) * n[:, None] // n_batches
    counts = np.diff(ends, axis=1, prepend=0).astype(np.uint8)
    batch = np.repeat(np.tile(np.arange(n_batches), len(n)), counts.ravel().astype(int))
    number = number[np.lexsort((number, batch, np.arange(len(number)) // CHUNK))]
    _, words = number_starts(counts, frames.bits)
    stream = np.append(pack_numbers(number, counts, frames.bits), np.uint32(0))
    tables = {"splats": stream, "splat_word": words.cumsum() - words, "batch_count": counts}
    assert (unpack_numbers(stream, counts, frames.bits) == number).all()
    return named_frames(frames) | tables


@pytest.mark.parametrize("n_batches", [1, 3, 20, 60])
def test_numbers__sorted_take_fewer_bits_and_never_more(n_batches):
    position, normal = cases()["a bowl"]
    number, frames = encode_quadrics(position, normal, asked(position, 0.005))
    bits = 32 * (len(arrays_of(number, frames, n_batches)["splats"]) - 1) / len(number)
    saved = {1: 5, 3: 3.5, 20: 0.5, 60: 0}[n_batches]
    assert bits <= frames.bits.mean() - saved + 32 / len(number)


def test_numbers__a_vector_that_lacks_a_splat_is_refused():
    position, normal = cases()["a bowl"]
    arrays = arrays_of(*encode_quadrics(position, normal, asked(position)))
    arrays["splats"][0] &= arrays["splats"][0] - np.uint32(1)  # its lowest one goes
    with pytest.raises(ValueError, match="bit vector"):
        check_numbers(arrays)


def test_quadrics__mean_error_is_the_one_asked_for():
    """On a curved sheet of splats of several sizes, in radii of their own."""
    rng = np.random.default_rng(3)
    position = rng.uniform(0, 1, (40 * CHUNK, 3))
    position[:, 2] = 0.1 * np.sin(3 * position[:, 0]) + 0.004 * rng.standard_normal(len(position))
    order = median_split(position)
    position, radii = position[order], 0.02 * 2 ** rng.random(len(position))
    number, frames = encode_quadrics(position, np.tile([0.0, 0, 1], (len(position), 1)), asked_steps(radii, 1 / 30))
    off = np.linalg.norm(decode_quadrics(number, frames)[0] - position, axis=1) / radii
    assert 0.9 < 30 * off.mean() < 1.03


@pytest.mark.parametrize("error", [0.2, 0.32, 0.6])
def test_quadrics__mean_error_of_normals_is_the_one_asked_for(error):
    """All round a ball, where equal steps would be twice as far off in some places as in others."""
    rng = np.random.default_rng(4)
    unit_ = unit(rng.standard_normal((400 * CHUNK, 3)))
    unit_ = unit_[median_split(unit_)]
    number, frames = encode_quadrics(unit_, unit_, asked(unit_), error)
    found = decode_normals(decode_quadrics(number, frames)[1])
    off = np.degrees(np.arccos(np.clip((found * unit_).sum(axis=1), -1, 1))).reshape(-1, CHUNK).mean(axis=1)
    reached = frames.normal_grid > 0  # where no finer map would be needed
    assert abs(off[reached].mean() / error - 1) < 0.03 and reached.mean() > 0.1
    assert off[reached].std() < 0.1 * error


def test_quadrics__a_curved_piece_takes_cells_that_a_flat_one_would_not_have():
    """Heights are over the quadric: those of a bowl take a layer or two of cells, the same in another order a box
    full."""
    position, normal = cases()["a bowl"]
    shuffled = position.copy()
    shuffled[:, 2] = np.random.default_rng(1).permutation(shuffled[:, 2])
    bowl, box = (encode_quadrics(p, normal, asked(p))[1].bits.mean() for p in (position, shuffled))
    assert bowl < box - 2


def test_quadrics__normals_across_the_edges_of_the_map_take_no_more_steps():
    position, normal = cases()["looking down"]
    down, up = (
        encode_quadrics(position, normal * [1, 1, side], asked(position))[1].normal_cells.astype(int)
        for side in (1, -1)
    )
    assert (down.prod(axis=1) < 3 * up.prod(axis=1)).all() and up.prod(axis=1).max() < 300


@pytest.mark.parametrize("stray", [0.0, 30.0, 1e4, 1e9])
def test_quadrics__origins_count_in_their_groups_box_whatever_strays_there_are(stray):
    """Cells far smaller than units: of 1e9 2^14."""
    rng = np.random.default_rng(5)
    position = rng.uniform(0, 1, (GROUP + 200, 3)) * [1, 1, 0]
    position[7], normal = (stray, -stray, stray), np.tile([0.0, 0, 1], (GROUP + 200, 1))
    number, frames, named = quadrics_of_groups(position, normal, asked(position))
    assert (frame_origins(named) == frames.origin).all() and len(np.unique(named["frame_box"], axis=0)) == 2
    found, _ = decode_quadrics(number, frames_of_arrays(named))
    others = np.arange(len(position)) >= CHUNK
    assert np.abs(found - position)[others].max() <= max(0.01, 2e-8 * stray)
    alone, _, second = quadrics_of_groups(position[GROUP:], normal[GROUP:], asked(position[GROUP:]))
    assert (alone == number[GROUP:]).all() and (second["frame_box"] == named["frame_box"][-2:]).all()


def test_quadrics__a_chunk_does_not_depend_on_the_others():
    position, normal = cases()["a bowl"]
    whole, frames = encode_quadrics(position, normal, asked(position))
    second, alone = encode_quadrics(position[CHUNK:], normal[CHUNK:], asked(position[CHUNK:]))
    assert (whole[CHUNK:] == second).all()
    for name, values in named_frames(frames).items():
        assert (values[1:] == named_frames(alone)[name]).all()
