"""Which share of the training set the passes of k-SVD look at, and how they code it: few patches with exact weights
while atoms still move far, then all as they will be coded, so that atoms make up for what weights' levels leave."""

from __future__ import annotations

from pipeline.coding.beam.form import Beam, beam_of

COARSE = 10_000  # patches that the first passes look at
AS_CODED = 6  # passes at the end that look at all
LEARNING_BEAM = Beam(2, 2)  # of these, at most: 4x2 takes half as long again for 0.005 dB


def passes_as_coded(iterations: int) -> int:
    """How many of so many passes code with the pursuit, the weight levels and the multiplier of the scan."""
    return min(AS_CODED, iterations // 2)


def learning_pursuit(pursuit: str) -> str:
    """What these passes code with where the scan is coded with `pursuit`.

    >>> learning_pursuit("8x4"), learning_pursuit("omp")
    ('2x2', 'omp')
    """
    beam, most = beam_of(pursuit), LEARNING_BEAM
    return str(Beam(min(beam.width, most.width), min(beam.candidates, most.candidates))) if beam else pursuit


def rounds_of_passes(iterations: int, n_patches: int) -> tuple[tuple[float, int], ...]:
    """The passes over `n_patches` in rounds: the share that each pass of a round looks at, and the most passes of it;
    the last round is that of `passes_as_coded`, where there are any.

    >>> rounds_of_passes(8, 40_000), rounds_of_passes(2, 5_000), rounds_of_passes(1, 40_000)
    (((0.25, 4), (1.0, 4)), ((1.0, 1), (1.0, 1)), ((1.0, 1),))
    """
    n_last = passes_as_coded(iterations)
    share = COARSE / n_patches if n_last and n_patches > COARSE else 1.0
    return ((share, iterations - n_last), *(((1.0, n_last),) if n_last else ()))


def quantised_share(n_patches: int) -> float:
    """Of `n_patches`, the share that quantising looks at: as many as the first passes."""
    return min(1.0, COARSE / max(1, n_patches))
