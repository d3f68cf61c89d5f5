from dataclasses import replace

import numpy as np
import pytest

from storage.packed.batches import count_batches, rows_of
from storage.packed.codes import pack_codes, unpack_codes
from storage.packed.schema import CHUNK, MAX_ATOMS, Batch
from tests.packed_files import Case, header_of, noise
from tests.reference_packed import read_field

BATCHES = tuple(Batch(n) for n in range(MAX_ATOMS + 1))


def coded(dictionary_bits: int, weight_bits: int, n: int = 300):
    """A header, and entries, atom counts, atoms and weight codes of one group of `n` splats."""
    header = header_of(Case(dictionary_bits=dictionary_bits, weight_bits=weight_bits, n_ranks=MAX_ATOMS))
    batch = noise(n, 1, len(BATCHES))
    batch = batch[np.lexsort((batch, np.arange(n) // CHUNK))]
    rows = rows_of(count_batches(batch, len(BATCHES)), BATCHES)
    atom = noise(n * MAX_ATOMS, 2, 2**dictionary_bits).reshape(n, MAX_ATOMS)
    weight = noise(n * MAX_ATOMS, 3, 2**weight_bits).reshape(n, MAX_ATOMS)
    return replace(header, batches=BATCHES), rows.entry, batch, atom, weight


@pytest.mark.parametrize("bits", [(8, 4), (12, 4), (16, 8), (16, 4), (8, 8)])
def test_codes__every_code_comes_back_with_zeros_beyond_it(bits):
    header, entry, n_atoms, atom, weight = coded(*bits)
    words = np.append(pack_codes(header, entry, n_atoms, atom, weight), np.uint32(0xFFFFFFFF))
    found = unpack_codes(header, words, np.zeros(len(entry), np.uint32), entry, n_atoms)
    used = np.arange(MAX_ATOMS) < n_atoms[:, None]
    assert (found[0] == np.where(used, atom, 0)).all()
    assert (found[1] == np.where(used, weight, 0)).all()


@pytest.mark.parametrize("bits", [(8, 4), (12, 4), (16, 8)])
def test_codes__atom_index_lies_below_its_weight(bits):
    header, entry, n_atoms, atom, weight = coded(*bits)
    words = pack_codes(header, entry, n_atoms, atom, weight)
    for splat in np.flatnonzero(n_atoms)[:20]:
        field = read_field(words, int(entry[splat]) * header.entry_bits, header.entry_bits)
        assert field == atom[splat, 0] | weight[splat, 0] << header.dictionary_bits


def test_codes__take_atom_and_weight_bits_and_not_one_more():
    header, entry, n_atoms, atom, weight = coded(8, 4)
    assert len(pack_codes(header, entry, n_atoms, atom, weight)) == -(-int(n_atoms.sum()) * 12 // 32)


def test_codes__groups_are_found_by_their_first_word():
    header, entry, n_atoms, atom, weight = coded(12, 4)
    words = pack_codes(header, entry, n_atoms, atom, weight)
    both = np.concatenate([words[::-1], words, np.zeros(1, np.uint32)])
    second = unpack_codes(header, both, np.full(len(entry), len(words), np.uint32), entry, n_atoms)
    assert (second[0][:, 0] == np.where(n_atoms > 0, atom[:, 0], 0)).all()


def test_codes__splats_without_atoms_take_no_word():
    header = header_of(Case(n_ranks=MAX_ATOMS))
    none = np.zeros((5, MAX_ATOMS), np.int64)
    words = pack_codes(header, np.zeros(5, np.int64), np.zeros(5, np.int64), none, none)
    assert len(words) == 0
    spare = np.zeros(1, np.uint32)
    assert not unpack_codes(header, spare, spare.repeat(5), np.zeros(5, np.int64), np.zeros(5, np.int64))[0].any()
