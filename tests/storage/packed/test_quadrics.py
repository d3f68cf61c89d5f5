"""Files of splats over quadrics: what is refused, and groups by themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.splats.decoded import scene_normal_codes, scene_positions
from storage.errors import InvalidPackedFile
from storage.packed.packed import PackedFile
from storage.packed.quadrics import high_bits
from storage.packed.schema import GROUP
from tests.packed_files import Case, arrays_for, header_of, write_arrays, write_packed_file
from tests.reference_packed import number_of

CURVED = Case(n_splats=300, atom_counts=(0, 2), n_dictionary=3, quadrics=True)
SIZED = replace(CURVED, size_bits=4)
TWO_GROUPS = Case(n_splats=GROUP + 300, n_dictionary=0, atom_counts=(0,), size_bits=3, quadrics=True)


def test_quadrics__a_group_alone_decodes_as_in_the_whole_file(tmp_path):
    with PackedFile(write_packed_file(TWO_GROUPS, tmp_path / "a.splatpress")) as packed:
        whole, alone = packed.load(), packed.group(1)
    assert (scene_positions(alone) == scene_positions(whole)[GROUP:]).all()
    assert (scene_normal_codes(alone) == scene_normal_codes(whole)[GROUP:]).all()


def test_quadrics__numbers_are_those_of_the_slow_twin(tmp_path):
    with PackedFile(write_packed_file(CURVED, tmp_path / "a.splatpress")) as packed:
        scene = packed.load()
    assert scene.numbers.tolist() == [number_of(scene, i) for i in range(CURVED.n_splats)]


def test_numbers__of_any_batch_take_no_more_bits_than_unsorted():
    n, bits = np.meshgrid(np.arange(129), np.arange(16, 48))
    high = high_bits(n.reshape(-1, 1), bits.ravel())[:, 0]
    n, bits = n.ravel(), bits.ravel()
    taken = n * (bits - high) + np.where(high > 0, n + (1 << high), 0)
    assert (taken <= n * bits).all() and (bits - high >= 16).all()
    assert taken[(n == 128) & (bits == 30)] == 128 * 30 - 5 * 128


WRONG = {
    "no cells": ("frame_cells", 0, "."),
    "cells beyond 12 bits": ("frame_cells", 4097, "frame_cells"),
    "numbers of 15 bits": ("frame_bits", 15, "."),
    "numbers of 48 bits": ("frame_bits", 48, "."),
    "no step": ("frame_step", 0, "frame_step"),
    "an infinite step": ("frame_step", 0x7F80, "."),
    "a negative step": ("frame_step", 0xBF80, "frame_step"),
    "normals beyond both edges": ("normal_low", 255, "normal_low"),
    "a map of normals too coarse": ("normal_grid", 16, "normal_grid"),
    "a turn of -128": ("frame_turn", -128, "-128"),
    "an origin beyond its group's box": ("frame_origin", 65535, "do not hold"),
    "a vector without ones": ("splats", 0, "bit vector"),
    "sizes upside down": ("size_scale", (90, 80), "size_scale"),
}


@pytest.mark.parametrize("name", WRONG)
def test_quadrics__tables_that_no_decoder_could_follow_are_refused(name, tmp_path):
    array, value, match = WRONG[name]
    case = SIZED if array == "size_scale" else CURVED
    header = header_of(case)
    arrays = arrays_for(case, header)
    arrays[array] = arrays[array].copy()
    arrays[array][0 if array != "splats" else slice(0, 8)] = value
    path = write_arrays(header, arrays, tmp_path / "a.splatpress")
    with pytest.raises(InvalidPackedFile, match=match), PackedFile(path) as packed:
        packed.load()


def test_quadrics__codes_of_sizes_have_no_more_bits_than_their_digit_may(tmp_path):
    header = header_of(replace(CURVED, size_bits=3))
    path = write_arrays(replace(header, size_bits=3), arrays_for(SIZED, header), tmp_path / "a.splatpress")
    with pytest.raises(InvalidPackedFile, match="size_bits"), PackedFile(path):
        pass


def test_quadrics__cells_beyond_32_bits_are_refused(tmp_path):
    header = header_of(CURVED)
    arrays = arrays_for(CURVED, header)
    arrays["normal_cells"] = np.where(arrays["frame_bits"][:, None] > 32, 0, arrays["normal_cells"]).astype(np.uint8)
    assert (arrays["frame_bits"] > 32).any()
    path = write_arrays(header, arrays, tmp_path / "a.splatpress")
    with pytest.raises(InvalidPackedFile, match="2\\^32"), PackedFile(path) as packed:
        packed.load()
