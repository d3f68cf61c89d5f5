"""Iso values that volumes propose: between materials, between labels, none where nothing differs."""

from __future__ import annotations

import numpy as np

from pipeline.volumes.proposals import BINS, Spectrum, bin_edges, labels_in, propose, spectrum_of
from tests.pipeline.volumes.made import ball


def spectrum(voxels: np.ndarray) -> Spectrum:
    whole = voxels.dtype.kind in "ui"
    return spectrum_of(voxels, len(voxels), bin_edges(float(np.nanmin(voxels)), float(np.nanmax(voxels)), whole))


def test_spectrum__counts_voxels_and_the_pairs_that_pass_each_bin_by_brute_force():
    voxels = np.random.default_rng(0).integers(0, 40, (7, 6, 5)).astype(np.uint8)
    found = spectrum(voxels)
    middle = (found.edges[:-1] + found.edges[1:]) / 2
    pairs, steps = np.zeros(BINS, int), np.zeros(BINS)
    for axis in range(3):
        a, b = (np.moveaxis(voxels, axis, 0)[s].astype(float).ravel() for s in (slice(None, -1), slice(1, None)))
        low, high = np.minimum(a, b), np.maximum(a, b)
        passed = (low[:, None] < middle) & (middle <= high[:, None])
        pairs += passed.sum(axis=0)
        steps += ((high - low)[:, None] * passed).sum(axis=0)
    assert np.array_equal(found.pairs, pairs) and np.allclose(found.steps, steps)
    assert np.array_equal(found.voxels, np.bincount(voxels.ravel(), minlength=BINS))


def test_spectrum__adds_up_over_slices():
    voxels = np.random.default_rng(1).normal(size=(13, 9, 8)).astype(np.float32)
    whole = spectrum(voxels)
    parts = [spectrum_of(voxels[k : k + 6], 5, whole.edges) for k in range(0, 13, 5)]
    assert np.array_equal(sum(p.pairs for p in parts), whole.pairs)
    assert np.array_equal(sum(p.voxels for p in parts), whole.voxels)


def test_propose__between_air_flesh_and_bone():
    flesh, bone = ball((40, 40, 40), radius=16.0) > 50, ball((40, 40, 40), radius=9.0) > 50
    exact = 1000 * flesh.astype(float) + 1500 * bone
    blurred = sum(np.roll(exact, shift, axis) for axis in range(3) for shift in (-1, 0, 1)) / 9
    voxels = (blurred + np.random.default_rng(2).normal(0, 30, blurred.shape)).astype(np.int16)
    found = sorted(p.iso for p in propose(spectrum(voxels), False)[:2])
    assert 150 < found[0] < 900 and 1100 < found[1] < 2400


def test_propose__between_labels_and_nothing_of_a_constant_volume():
    voxels = np.zeros((12, 12, 12), np.uint8)
    voxels[2:6], voxels[7:10] = 3, 7
    found = spectrum(voxels)
    assert labels_in(found, True).tolist() == [0, 3, 7]
    assert [p.iso for p in propose(found, True)] == [0.5, 3.5]
    assert labels_in(spectrum(ball().astype(np.uint8)), True) is None
    assert not propose(spectrum(np.full((4, 4, 4), 9, np.uint8)), False)
