"""Pursuit of a block of patches with a Gram matrix: the kernel that the rules ask for."""

from __future__ import annotations

import numpy as np

from pipeline.coding.beam.by_gram import pursue_beam
from pipeline.coding.omp_kernels import pursue
from pipeline.coding.search.protocol import Found, Rules


def pursue_by_gram(
    patches: np.ndarray,  # (n, d) float32
    energy: np.ndarray,  # (n,) float64
    dictionary: np.ndarray,  # (k, d) float32
    product: np.ndarray,  # (n, k) float32: <patch, atom>, no further off than spread[i] * rest[a]; overwritten
    spread: np.ndarray,  # (n,) float32
    rest: np.ndarray,  # (k,) float32
    gram: np.ndarray,  # (k / m, k) float32
    quotients: np.ndarray,  # (m, m) int64
    rules: Rules,
    found: Found,
) -> None:
    """Fills `found`; arguments as of `omp_kernels.pursue`."""
    products = (product, spread, rest, rules.certify, energy, gram, quotients)
    stop = (rules.tolerance, rules.multiplier, rules.levels)
    if rules.beam is None:
        pursue(patches, dictionary, *products, *stop, *found)
    else:
        pursue_beam(patches, dictionary, *products, *stop, rules.beam.width, rules.beam.candidates, *found)
