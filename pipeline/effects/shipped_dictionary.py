"""Atoms that ship with the program in place of ones learned from the scan: for photographs of few splats, which would
pay more for atoms of their own than these gain.

The atoms are those of storage/packed/dictionaries; the order of stages is in services/flow/textures.py.
"""

from __future__ import annotations

from pipeline.effects.block import Sources
from pipeline.effects.effect import Effect, Measured, Worth
from pipeline.planning.settings import Settings
from storage.packed.dictionaries.shipped import ATOM_BYTES, N_ATOMS


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
    threshold=own_bytes_a_splat(20_000),
    reason="@@",
    worth=Worth("@@", bytes_a_splat=0.0),
    conclude=_conclude,
    order=66,
)
