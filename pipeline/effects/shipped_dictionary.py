"""Atoms that ship with the program in place of ones learned from the scan: for photographs of few splats, which would
pay more for atoms of their own than these gain.

The atoms are those of storage/packed/dictionaries; the order of stages is in services/flow/textures.py.
"""

from __future__ import annotations

from pipeline.effects.block import Sources
from pipeline.effects.effect import Effect, Measured, Worth
from pipeline.planning.settings import Settings
from storage.packed.dictionaries.shipped import ATOM_BYTES, N_ATOMS

MOST_SPLATS = 50_000  # that gain by it without taking longer


def own_bytes_a_splat(n_splats: int) -> float:
    """Bytes a splat that a dictionary of the scan's own would take, were it as large.

    >>> round(own_bytes_a_splat(10_000), 1)
    39.5
    """
    return N_ATOMS * ATOM_BYTES / n_splats


def takes_shipped(settings: Settings, n_splats: int) -> bool:
    """Whether photographs on so many splats take it, as far as settings and numbers tell."""
    few = own_bytes_a_splat(n_splats) >= EFFECT.threshold
    return settings.dictionary == "shipped" or (settings.dictionary == "auto" and settings.fits_shipped and few)


def _conclude(sums: list[dict], sources: Sources) -> Measured:
    if not sources.scan.cameras:
        return Measured(0.0)
    return Measured(own_bytes_a_splat(sources.n_splats), 1.0)


EFFECT = Effect(
    name="shipped_dictionary",
    title="Atoms are those that ship with the program, and take no bytes of the file",
    measures="bytes a splat that as many atoms of the scan's own would take; scans with photographs",
    threshold=own_bytes_a_splat(MOST_SPLATS),
    reason="at equal bytes of the file fountain_p11 gains 1.1 dB with 2,000 splats, 0.8 with 5,000, 0.9, 0.7 and 0.6 with 10,000, "
    "20,000 and 50,000, monstree 0.7 and 0.8 with 5,000 and 20,000, 0.7 with 50,000; of 100,000 coding takes twice as long, and "
    "the GPU 5 bytes a splat",
    worth=Worth("fountain_p11, balanced, density 0.01515, of equal bytes", gain_db=0.8),
    conclude=_conclude,
    order=66,
)
