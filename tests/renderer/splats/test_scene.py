"""What is uploaded: tables against counting by hand, bytes, and refusals."""

from types import SimpleNamespace

import numpy as np
import pytest

from renderer.splats.atlas import atlas_layout, atlas_picture
from renderer.splats.scene import DRAWS, LOOKED_UP, GpuScene, Look, storage_buffer
from renderer.splats.upload.tables import group_boxes, group_table, running_counts, splat_words
from storage.errors import ResourceExhausted
from storage.packed.schema import CHUNK, GROUP, MIP_SIZES
from tests.mapped_scenes import wall_map, with_maps
from tests.scenes import Settings, build_scene, camera_looking, coded, random_dictionary, sheet


def scene_of_two_groups():
    rng = np.random.default_rng(0)
    n = GROUP + 300
    line = np.tile([1.0, 0.0, 0.2], (n, 1))
    line[rng.random(n) < 0.8] = np.nan
    splats = sheet(rng, n, half_width=1.0, clipline=line, **coded(rng, n, max_atoms=3))
    return build_scene(splats, Settings(radius=0.01), random_dictionary(rng))


def test_running_counts__are_the_counts_of_splats_so_far_in_the_group():
    scene = scene_of_two_groups()
    table, batch = running_counts(scene.arrays["batch_count"]), scene.rows.batch
    for chunk in (0, 1, 40, 63, 64, 66):
        group_start = chunk * CHUNK // GROUP * GROUP
        so_far = batch[group_start : (chunk + 1) * CHUNK]
        assert table[chunk].tolist() == [(so_far < b).sum() for b in range(1, len(scene.header.batches))]


def test_group_table__says_where_each_batch_begins():
    scene = scene_of_two_groups()
    table = group_table(scene)
    for group in (0, 1):
        members = slice(group * GROUP, (group + 1) * GROUP)
        assert table[group, 0] == scene.arrays["group_word"][group]
        assert table[group, 1] == scene.arrays["clipline_word"][group]
        for b, kind in enumerate(scene.header.batches):
            of_batch = scene.rows.batch[members] == b
            assert table[group, 2 + 2 * b] == scene.rows.entry[members][of_batch].min()
            if kind.clipline:
                assert table[group, 3 + 2 * b] == scene.rows.clipline[members][of_batch].min()


def test_group_boxes__hold_their_discs():
    scene = scene_of_two_groups()
    boxes, low = group_boxes(scene), scene.arrays["box_low"]
    assert (boxes[0, :3] <= low[:64].min(axis=0) - 0.01).all() and (boxes[1, 3:] >= low[64:].max(axis=0) + 0.01).all()


def test_splat_words__hold_position_normal_and_color_in_eight_bytes():
    arrays = scene_of_two_groups().arrays
    words = splat_words(arrays)
    assert words.shape[1] == 8
    assert (words[:, :3] == arrays["position"]).all() and (words[:, 3:5].view(np.int8) == arrays["normal"]).all()
    assert (words[:, 5:] == arrays["color"]).all()


@pytest.mark.parametrize("n_atoms", [1, 7, 256])
def test_atlas_picture__holds_every_atom_at_every_level_at_its_corner(n_atoms):
    rng = np.random.default_rng(1)
    levels = [rng.integers(-127, 128, (n_atoms, size, size, 3)).astype(np.int8) for size in MIP_SIZES]
    layout = atlas_layout(n_atoms)
    picture = atlas_picture(levels, layout)
    for level, size in enumerate(MIP_SIZES):
        for atom in range(n_atoms):
            column, row = layout.corner(atom, level)
            assert (picture[row : row + size, column : column + size] == levels[level][atom]).all()


@pytest.mark.parametrize("n_atoms", [256, 1024, 4096, 65536])
def test_atlas_layout__wastes_next_to_nothing_and_fits_common_drivers(n_atoms):
    layout = atlas_layout(n_atoms)
    assert max(layout.width, layout.height) <= 16384
    assert layout.width * layout.height <= 1.002 * n_atoms * sum(size * size for size in MIP_SIZES)


def test_gpu_scene__counts_the_bytes_of_every_buffer_and_texture(renderer):
    scene = scene_of_two_groups()
    gpu_scene = GpuScene(scene, renderer.context)
    parts, n, arrays = gpu_scene.bytes_by_part, scene.header.n_splats, scene.arrays
    assert parts["colors"] == 3 * n
    assert parts["geometry"] == 5 * n + 28 * scene.header.n_chunks + 24 * 2 + arrays["cliplines"].nbytes
    layout = atlas_layout(20)
    atlas_bytes = 3 * layout.width * layout.height
    assert parts["dictionary"] == atlas_bytes + 16 * 16 * 4 + 20 * 4
    tables = scene.header.n_chunks * (len(scene.header.batches) - 1) * 2
    assert 0 <= parts["codes"] - arrays["codes"].nbytes - tables - group_table(scene).nbytes < 4
    assert gpu_scene.total_bytes == sum(parts.values())
    assert sum(b.size for key, b in gpu_scene.buffers.items() if key != DRAWS) == gpu_scene.total_bytes - atlas_bytes
    gpu_scene.release()


def test_storage_buffer__refuses_more_than_the_driver_takes_and_names_the_sizes():
    context = SimpleNamespace(info={"GL_MAX_SHADER_STORAGE_BLOCK_SIZE": 1000, "GL_RENDERER": "a small one"})
    with pytest.raises(ResourceExhausted, match="1,004 bytes.*1,000 bytes with a small one"):
        storage_buffer(context, np.zeros(251, np.float32), "codes")


def test_gpu_scene__from_afar_takes_programs_without_maps_and_draws_the_same(renderer):
    scene = build_scene(sheet(np.random.default_rng(2), 80), Settings(radius=0.15))
    gpu_scene = GpuScene(with_maps(scene, wall_map()), renderer.context)
    near, far = (camera_looking((0, -away, 0), (0, 0, 0), (48, 40), (60, 60)) for away in (0.8, 8.0))
    renderer.render(gpu_scene, near)
    assert len(gpu_scene.looks) > 1
    picture = renderer.render(gpu_scene, far)
    assert gpu_scene.looks == (Look({"CLIPLINE": 0}),)
    gpu_scene.in_view, gpu_scene.looks_up = None, True
    gpu_scene.buffers[LOOKED_UP].write(np.ones(1, np.uint32))
    in_full = renderer.render(gpu_scene, far)
    gpu_scene.release()
    assert picture.coverage.any() and (picture.coverage == in_full.coverage).all()
    assert np.abs(picture.rgb.astype(int) - in_full.rgb).max() <= 1
