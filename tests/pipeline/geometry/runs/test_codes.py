"""Codes of runs: the same cells back, normals within degrees, groups that hold what their tables say."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.hcp import centres_of, key_of
from pipeline.geometry.normals import decode_normals, encode_normals
from pipeline.geometry.runs.cells import search_size
from pipeline.geometry.runs.codes import MOST_RUNS, cones, decode_runs, encode_runs
from pipeline.geometry.runs.normals import N_STEPS, wrapped
from pipeline.geometry.runs.starts import bits_of, pack_starts
from pipeline.geometry.runs.walks import runs_of
from tests.pipeline.geometry.runs.test_cells import sphere


@pytest.fixture(scope="module")
def coded():
    cells = search_size(sphere(60_000), 3.5)
    normal = centres_of(cells.key, cells.size)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    codes, place = encode_runs(cells.key, normal, runs_of(cells.key))
    return cells, normal, codes, place


def keys_of_index(index: np.ndarray) -> np.ndarray:
    return np.array([key_of(*map(int, i)) for i in index])


def degrees(code: np.ndarray, normal: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((decode_normals(code) * normal).sum(axis=1), -1, 1)))


def test_codes__decode_to_the_same_cells_and_to_normals_within_degrees(coded):
    cells, normal, codes, place = coded
    index, code = decode_runs(codes)
    assert np.array_equal(keys_of_index(index), cells.key[place])
    off = degrees(code, normal[place])
    assert off.mean() < 1.5 and np.quantile(off, 0.99) < 5
    ends = np.concatenate([np.flatnonzero(np.arange(len(place)) % 25 == 24)])
    assert off[ends].mean() < 2 * off.mean()  # errors do not add up along runs


def test_codes__take_few_bits_and_say_which(coded):
    _, _, codes, _ = coded
    bits, starts = bits_of(codes), pack_starts(codes)
    arrays = (starts.sections, starts.words, codes.step, codes.codebook)
    assert np.isclose(sum(bits.values()) * codes.n_cells, 8 * sum(a.nbytes for a in arrays), rtol=1e-4)
    assert bits["steps"] < 3 and bits["normals"] < 5 and sum(bits.values()) < 9.7
    assert bits["start"] + bits["start_normal"] < 0.75 * 48 * len(codes.start) / codes.n_cells
    assert codes.codebook.shape == (N_STEPS, 2) and not codes.codebook[0].any()


@pytest.mark.parametrize("far", [0, 2**20 - 2100, -(2**20) + 2])
def test_starts__are_read_back_bit_by_bit_as_the_shader_reads_them(far):
    rng = np.random.default_rng(3)
    index = rng.integers(0, 2048, (300, 3)) * [1, 1, 0] + far
    keys = np.unique(keys_of_index(np.concatenate([index, index[:9] + [1, 0, 0]])))
    codes, _ = encode_runs(keys, sphere(len(keys)), runs_of(keys))
    starts = pack_starts(codes)
    stream = int.from_bytes(starts.words.tobytes(), "little")
    index, _ = decode_runs(codes)
    cell = 0
    for section, after in zip(starts.sections[:-1].tolist(), starts.sections[1:].tolist()):
        least = [(word & (1 << 22) - 1) - (word >> 21 & 1) * (1 << 22) for word in section[:3]] + [0]
        least += [(word >> 22 & 255) - (word >> 29 & 1) * 256 for word in section[:2]]
        at = 32 * section[5]
        for run in range(section[3], after[3]):
            found = []
            for i in range(6):
                n = section[6] >> 4 * i & 15
                found.append(least[i] + (stream >> at & (1 << n) - 1))
                at += n
            assert found[:3] == index[cell].tolist() and found[4:] == codes.normal[run].tolist()
            cell += found[3] + 1
        assert at <= 32 * after[5] and cell == after[3] + after[4]
    assert cell == codes.n_cells


def test_codes__groups_hold_at_most_256_runs_and_their_cones_all_normals(coded):
    _, _, codes, _ = coded
    assert np.diff([*codes.first_run, len(codes.start)]).max() <= MOST_RUNS
    axis, angle = cones(codes)
    _, code = decode_runs(codes)
    begin = codes.first_run.astype(int) + codes.first_step
    group = np.searchsorted(begin, np.arange(len(code)), side="right") - 1
    off = np.arccos(np.clip((decode_normals(code) * axis[group]).sum(axis=1), -1, 1))
    assert (off <= angle[group] + 1e-6).all()


@pytest.mark.parametrize("far", [0, 2**18, -(2**19)])
def test_codes__far_and_wide_grids_and_lone_cells(far):
    rng = np.random.default_rng(0)
    index = rng.integers(-3000, 3000, (400, 3)) + far
    keys = np.unique(keys_of_index(index))
    codes, place = encode_runs(keys, sphere(len(keys)), runs_of(keys))
    found, code = decode_runs(codes)
    assert np.array_equal(keys_of_index(found), keys[place]) and len(codes.start) == len(keys)
    assert degrees(code, sphere(len(keys))[place]).max() < 0.7


def test_normals__steps_go_over_the_edges_of_the_map_by_the_shortest_way():
    for a, b in ((127, 40), (130, 40), (-131, 5), (20, 129), (20, -140)):
        x, y = wrapped(a, b)
        assert max(abs(x), abs(y)) <= 127
    # A point beyond an edge lies near the edge's point.
    edge, beyond = decode_normals(np.array([[127, 40]], np.int8)), decode_normals(np.array([wrapped(130, 40)], np.int8))
    assert np.degrees(np.arccos((edge * beyond).sum())) < 4


def test_normals__turning_through_every_direction_stay_near():
    """Circles of normals over poles, folds and corners of the map."""
    angle = np.linspace(0, 2 * np.pi, 2000)
    keys = np.array([key_of(c, 0, 0) for c in range(2000)])
    for axis in sphere(12, seed=4):
        u = np.cross(axis, [0.3, 0.5, 0.7])
        u /= np.linalg.norm(u)
        normal = np.outer(np.cos(angle), u) + np.outer(np.sin(angle), np.cross(axis, u))
        codes, place = encode_runs(keys, normal, runs_of(keys))
        assert degrees(decode_runs(codes)[1], normal[place]).mean() < 1.0
    assert encode_normals(normal).min() >= -127
