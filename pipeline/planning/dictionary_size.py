"""How many atoms a scan pays for, and of how many texels."""

from __future__ import annotations

import numpy as np

from pipeline.coding.grid import SYMMETRIES, AtomForm
from pipeline.planning.settings import Settings
from pipeline.summaries import Training, Updated
from storage.packed.schema import ATOM_SIZES

PATCHES_AN_ATOM = 4  # a dictionary that a scan can fill: fewer training patches an atom would only be stored
# `auto`, at most: on fountain_p11 and monstree four times the atoms gained 0.3 dB where they cost 0.3 bytes a splat more.
DICTIONARY_BYTES_A_SPLAT = 0.5
# Of the bytes of codes, as the first pass of learning takes atoms. Bytes a splat on the GPU with 512, 256 and 128 atoms,
# `balanced`: fountain_p11 (2.6 atoms a splat then) 11.06, 10.92, 10.93 at 40.54, 40.53, 40.54 dB, over quadrics 9.34, 9.17
# at 40.43, 40.41; monstree for 34.5 dB (3.6) 14.48, 14.62 at 35.04, 35.02; not tuned on: the demo's stereo pair (1.6)
# 9.32, 9.08, 9.00 at 41.72, 41.68, 41.68.
SHARE_OF_CODES = 1 / 15
# Of atoms of station maps, which are as small as their texels: atoms of conference_room (a tenth, `balanced`) are 0.62 dB
# below patches that are not coded in a picture from near the station with half a byte (659 kB), 0.35 with 1.5 (758 kB).
MAP_DICTIONARY_BYTES_A_SPLAT = 1.5
FEWEST_INDEX_BITS, MOST_INDEX_BITS = 8, 12
# Bytes a splat that the fewest atoms of a size may take with their mip levels, 8x8 excepted. Thinned, `balanced`, bytes
# of the file a splat: fountain_p11 of 2,014 splats with 32x32, 16x16, 8x8 texels 90.2, 46.5, 36.7 at 27.34, 27.30,
# 26.73 dB; of 5,000 45.8, 28.8, 23.1 at 28.73, 28.71, 28.07; of 19,997 22.9, 18.9, 17.2 at 31.92, 31.90, 31.48;
# monstree of 5,015 47.4, 31.1, 26.2 at 24.03, 24.02, 23.91.
MOST_BYTES_OF_FEWEST = 2.0
# And that as many as are asked for may take. Thinned to 108,895 splats, `archive` (512 atoms), bytes a splat on the GPU:
# fountain_p11 with 32x32, 16x16, 8x8 texels 50.6, 36.1, 28.3 at 43.53, 43.46, 41.55 dB; 19.3, 4.8 and 1.2 of the
# dictionary.
MOST_BYTES_OF_ASKED = 8.0


def affordable_size(n_splats: int, dictionary_bits: str | int = "auto") -> int:
    """The most texels to a side of which a scan of so many splats pays for the fewest atoms, and for those asked for.

    >>> [affordable_size(n) for n in (2_000, 20_000, 330_000)], affordable_size(110_000, 12)
    ([8, 16, 32], 16)
    """
    fewest = 4 * 2**FEWEST_INDEX_BITS // SYMMETRIES
    asked = fewest if dictionary_bits == "auto" else 4 * 2 ** int(dictionary_bits) // SYMMETRIES
    most = min(MOST_BYTES_OF_FEWEST / fewest, MOST_BYTES_OF_ASKED / asked) * n_splats  # texels of an atom
    return max([min(ATOM_SIZES), *(size for size in ATOM_SIZES if size**2 <= most)])


def index_bits(settings: Settings, form: AtomForm | None, n_splats: int, of_maps: bool = False) -> int:
    """Bits of an index: those asked for, or as many as the scan pays for; `of_maps` of stations, not photographs."""
    if settings.dictionary_bits != "auto":
        return int(settings.dictionary_bits)
    if form is None:
        return FEWEST_INDEX_BITS
    return _paid_bits(form, n_splats, MAP_DICTIONARY_BYTES_A_SPLAT if of_maps else DICTIONARY_BYTES_A_SPLAT)


def codes_bytes_a_splat(entry_bits: int, training: Training, first: Updated) -> float:
    """What codes of so many bits an atom take, as a pass of learning takes atoms."""
    a_splat = first.n_atoms_used / first.n_patches * training.n_active / training.n_splats
    return a_splat * entry_bits / 8


def bits_for_codes(form: AtomForm, bits: int, n_splats: int, codes_bytes_a_splat: float) -> int:
    """As `bits`, or fewer where so many atoms would take more than SHARE_OF_CODES.

    >>> fountain, monstree = 2.55 * 16 / 8, 3.6 * 16 / 8
    >>> bits_for_codes(AtomForm(8, 8), 12, 330_000, fountain), bits_for_codes(AtomForm(8, 8), 12, 330_000, monstree)
    (11, 12)
    """
    return min(bits, _paid_bits(form, n_splats, SHARE_OF_CODES * codes_bytes_a_splat))


def _paid_bits(form: AtomForm, n_splats: int, bytes_a_splat: float) -> int:
    affordable = n_splats * bytes_a_splat / (4 * form.size**2) * form.n_turns
    return int(np.clip(np.log2(max(1.0, affordable)), FEWEST_INDEX_BITS, MOST_INDEX_BITS))
