"""Where runs start, as a graphics card holds it: each field in the bits that its section needs.

DuoDecim (2006), section 2.5, takes 2 x 16 bits for a place and 16 for a normal. Runs of a section lie near each other and look about the same
way, so that fields which count from the section's least take half of that. A section is SECTION_WORDS words: least column, row and slice, 22 bits
each with 8 bits of least a and b of the normal above the first two; its first run, the first of its steps, the first word of its starts; and the
bits of each field, 4 each.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.runs.codes import RunCodes
from storage.packed.schema import COLUMN_BITS, LENGTH_BITS, ROW_BITS, SLICE_BITS

SECTION_WORDS = 7
PLACE_BITS = 22  # of a least column, row or slice, of which the highest is its sign
N_FIELDS = 6  # column, row, slice, length - 1, a and b of the normal: in this order, the lowest bit first
OF_NORMAL = 2  # the last of them


@dataclass(frozen=True)
class Starts:
    """The tables and the fields of all runs."""

    sections: np.ndarray  # (n_sections + 1, SECTION_WORDS) uint32; the last says where runs, steps and words end
    words: np.ndarray  # uint32, two spare, as the fields may end; sections begin on whole ones
    place_bits: int  # of all runs' columns, rows, slices and lengths, with what fills up words
    normal_bits: int


def pack_starts(codes: RunCodes) -> Starts:
    """What a graphics card holds in place of `base`, `first_run`, `first_step`, `start` and `normal`.

    Guarantees: `renderer/shaders/decode_runs.comp.glsl` reads the same whole numbers of it.
    """
    n_sections, n_runs = len(codes.base), len(codes.start)
    section = np.searchsorted(codes.first_run, np.arange(n_runs), side="right") - 1
    field = _fields(codes, section)
    least = np.minimum.reduceat(field, codes.first_run.astype(np.int64), axis=0)
    least[:, 3] = 0
    field -= least[section]
    widest = np.maximum.reduceat(field, codes.first_run.astype(np.int64), axis=0)
    bits = np.ceil(np.log2(widest + 1)).astype(np.int64)
    count = np.diff(codes.first_run.astype(np.int64), append=n_runs)
    words = -(-count * bits.sum(axis=1) // 32)
    sections = np.zeros((n_sections + 1, SECTION_WORDS), np.uint32)
    sections[:-1, :3] = least[:, :3] & (1 << PLACE_BITS) - 1
    sections[:-1, :2] |= ((least[:, 4:] & 0xFF) << PLACE_BITS).astype(np.uint32)
    sections[:, 3] = [*codes.first_run, n_runs]
    sections[:, 4] = [*codes.first_step, len(codes.step)]
    sections[:, 5] = np.concatenate([[0], np.cumsum(words)])
    sections[:-1, 6] = (bits << 4 * np.arange(N_FIELDS)).sum(axis=1)
    normal_bits = int((bits[:, -OF_NORMAL:].sum(axis=1) * count).sum())
    return Starts(sections, _streams(field, bits, sections, section), 32 * int(words.sum()) - normal_bits, normal_bits)


def _fields(codes: RunCodes, section: np.ndarray) -> np.ndarray:
    """(n_runs, N_FIELDS) int64 of each run."""
    word, shift, parts = codes.start.astype(np.int64), 0, []
    for n in (COLUMN_BITS, ROW_BITS, SLICE_BITS, LENGTH_BITS):
        parts.append(word >> shift & (1 << n) - 1)
        shift += n
    place = np.stack(parts[:3], axis=1) + codes.base[section]
    return np.column_stack([place, parts[3], codes.normal.astype(np.int64)])


def _streams(field: np.ndarray, bits: np.ndarray, sections: np.ndarray, section: np.ndarray) -> np.ndarray:
    """Fields as words, run by run."""
    words = np.zeros(int(sections[-1, 5]) + 2, np.uint32)
    of_run = np.arange(len(field)) - sections[section, 3].astype(np.int64)
    at = 32 * sections[section, 5].astype(np.int64) + of_run * bits.sum(axis=1)[section]
    for i in range(N_FIELDS):
        shifted = field[:, i].astype(np.uint64) << (at & 31).astype(np.uint64)
        np.bitwise_or.at(words, at >> 5, (shifted & np.uint64(0xFFFFFFFF)).astype(np.uint32))
        np.bitwise_or.at(words, (at >> 5) + 1, (shifted >> np.uint64(32)).astype(np.uint32))
        at += bits[section, i]
    return words


def bits_of(codes: RunCodes) -> dict[str, float]:
    """Bits a cell on a graphics card, by part."""
    starts, n = pack_starts(codes), codes.n_cells
    return {
        "start": starts.place_bits / n,
        "start_normal": starts.normal_bits / n,
        "steps": 3 * len(codes.step) / n,
        "normals": 5 * len(codes.step) / n,
        "tables": 8 * (starts.sections.nbytes + 8 + codes.codebook.nbytes) / n,
    }
