"""docs/FORMAT.md is enough to write a viewer: the decoder made from the page alone against the product."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.geometry.ellipsoids import decode_ellipsoids
from pipeline.splats.decoded import scene_normal_codes, scene_radii
from renderer.splats.scene import GpuScene
from storage.maps import IN_PART
from storage.packed.dictionaries.shipped import FOLDER
from storage.packed.packed import PackedFile
from storage.packed.schema import Camera
from tests import format_decoder, format_runs
from tests.format_decoder import Packed, View, render
from tests.mapped_scenes import STATION, wall_map, with_maps
from tests.packed_files import Case, write_arrays, write_packed_file
from tests.reference_packed import decode_clipline, decode_patch, decode_position, decode_radius
from tests.renderer.reference_renderer import agreement_db
from tests.scenes import Dictionary, Settings, build_scene, camera_looking, coded, random_dictionary, sheet

CASES = [
    Case(n_splats=300),
    Case(size_bits=3, ellipsoids=True),
    Case(size_bits=3, ellipsoids=True, runs=True),
    Case(size_bits=3, ellipsoids=True, quadrics=True),
    Case(dictionary_bits=12, n_dictionary=300, atom_size=8, n_turns=8, cliplines=True),
    Case(n_dictionary=0, atom_counts=(0,), color_step=112, cliplines=True, ellipsoids=True),
    Case(n_dictionary=0, atom_counts=(0,), n_maps=2),
    Case(dictionary_bits=12, n_dictionary=500, atom_size=16, n_turns=8, coarsest_size=2, shipped=True),
    Case(
        atom_counts=(0, 5, 16),
        n_ranks=16,
        color_step=80,
        ellipsoids=True,
        coarsest_size=4,
        up=(7, -20, 5),
        ahead=(0, 1, 4),
    ),
]


def test_format_decoder__knows_nothing_of_the_product():
    names = set()
    for file in (format_decoder.__file__, format_runs.__file__):
        tree = ast.parse(Path(file).read_text())
        names |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        names |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    own = {"tests.format_runs"}
    assert (
        names
        == {
            "__future__",
            "dataclasses",
            "io",
            "pathlib",
            "numpy",
            "zarr",
            "zarr.storage",
            "PIL",
            "numcodecs.zstd",
            "hashlib",
        }
        | own
    )


@pytest.mark.parametrize("case", CASES)
def test_format_decoder__decodes_what_the_product_does(case, tmp_path):
    path = write_packed_file(case, tmp_path / "a.splatpress")
    packed = Packed(path, FOLDER)
    with PackedFile(path) as opened:
        scene = opened.load()
    some, fields = scene.ellipsoids
    axes = (
        decode_ellipsoids(fields, scene_normal_codes(scene)[some], case.up, case.ahead, scene_radii(scene)[some])
        if len(some)
        else []
    )
    expected_axes = dict(zip(some.tolist(), axes, strict=True))
    for i in (0, 1, 127, 128, 200, case.n_splats - 1):
        splat = packed.splat(i)
        assert np.array_equal(splat.position, np.array(scene.header.origin) + decode_position(scene, i))
        assert splat.radius == decode_radius(scene, i)
        assert (splat.clipline is None) == (decode_clipline(scene, i) is None)
        if splat.clipline is not None:
            np.testing.assert_allclose(splat.clipline, decode_clipline(scene, i), atol=1e-12)
        assert (splat.axes is None) == (i not in expected_axes)
        if splat.axes is not None:
            np.testing.assert_allclose(splat.axes, expected_axes[i], rtol=1e-6, atol=1e-7)
        size = packed.header["atom_size"]
        middles = (np.arange(size) + 0.5) * 2 / size - 1
        place = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
        patch = splat.color + (
            packed.sum_of_atoms(splat.atoms, place, 5 - int(np.log2(size)))
            if splat.atoms
            else np.zeros((len(place), 3))
        )
        np.testing.assert_allclose(patch.reshape(size, size, 3), decode_patch(scene, i, size), atol=1e-6)


def thin_axes(rng, n):
    """Half axes along x, z and the normal of a sheet, of a third of the splats."""
    axes = np.tile(np.diag([0.12, 0.06, 0.03])[[0, 2, 1]], (n, 1, 1))
    axes[rng.random(n) < 0.6] = np.nan
    return axes


def scene_of(name):
    rng = np.random.default_rng(7)
    plain = random_dictionary(rng)
    if name == "turned":
        means = plain.atoms.reshape(20, 16, 2, 16, 2, 3).mean(axis=(2, 4)).round().astype(np.int8)
        dictionary = Dictionary(means, plain.scale, plain.weight_levels, n_turns=8)
        return build_scene(sheet(rng, 100, **coded(rng, 100, 160)), Settings(radius=0.15, color_step=112), dictionary)
    if name == "cliplines":
        line = np.tile([0.8, 0.6, 0.1], (100, 1))
        line[rng.random(100) < 0.5] = np.nan
        return build_scene(sheet(rng, 100, clipline=line, **coded(rng, 100)), Settings(radius=0.15), plain)
    if name == "sizes":
        sizes = {"size": 0.15 * 2 ** rng.uniform(-1, 0.3, 100), "axes": thin_axes(rng, 100)}
        return build_scene(sheet(rng, 100, **sizes, **coded(rng, 100)), Settings(radius=0.12), plain)
    if name == "ellipsoids":
        return build_scene(sheet(rng, 100, axes=thin_axes(rng, 100), **coded(rng, 100)), Settings(radius=0.1), plain)
    if name == "maps":
        line = np.tile([0.8, 0.6, 0.1], (80, 1))
        axes = thin_axes(rng, 80)
        line[(rng.random(80) < 0.5) | np.isfinite(axes[:, 0, 0])] = np.nan
        scene = build_scene(sheet(rng, 80, axes=axes, tilt=0.1, clipline=line), Settings(radius=0.15))
        maps = wall_map(height=320), wall_map(STATION + [0.5, 0.2, 0.1], 112)
        station = rng.integers(-1, 2, 80)
        station[(station >= 0) & (rng.random(80) < 0.4)] += IN_PART
        return with_maps(scene, *maps, station=station)
    scene = build_scene(sheet(rng, 100, **coded(rng, 100)), Settings(radius=0.15), plain)
    return replace(scene, header=replace(scene.header, effects={"level_blending": {}})) if name == "blended" else scene


@pytest.mark.parametrize("distance", [0.9, 4.0, 12.0])
@pytest.mark.parametrize("name", ["atoms", "turned", "cliplines", "ellipsoids", "sizes", "blended", "maps"])
def test_format_decoder__draws_what_the_product_does(renderer, name, distance, tmp_path):
    scene = scene_of(name)
    packed = Packed(write_arrays(scene.header, scene.arrays, tmp_path / "a.splatpress"))
    # of maps: looked up at the finest level; at a coarser one, and some in part; those of the second map alone
    focal = (135 if name == "maps" else 45) * distance**0.5
    camera = camera_looking((0.2 * distance, -distance, 0.3), (0, 0, 0), (48, 40), (focal, focal))
    gpu_scene = GpuScene(scene, renderer.context)
    picture = renderer.render(gpu_scene, camera)
    gpu_scene.release()
    expected, covered = render(packed, view_of(camera))
    assert covered.mean() > 0.05
    assert (covered != picture.coverage).mean() <= 0.002
    assert agreement_db(picture.rgb, expected, lambda moved: render(packed, view_of(moved))[0], camera) >= 45


def view_of(camera: Camera) -> View:
    lens = camera.width_px, camera.height_px, camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px
    return View(*lens, np.array(camera.rotation), np.array(camera.centre))
