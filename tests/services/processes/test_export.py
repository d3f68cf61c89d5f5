"""Exports, each opened by a program of others: plyfile, laspy, splat-transform, gltf-validator, pygltflib."""

import json
import re
import struct
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.exports.cloud import SAMPLE_RADIUS, WINDOW_IN_RADII, cloud_of, samples_of
from pipeline.exports.formats import AUTO, FORMATS, GAUSSIANS, PACKED, PAGE, POINTS
from pipeline.exports.gaussians import FLATNESS, OPACITY, SH_0, SIGMA_IN_RADII, gaussians_of, to_y_up
from services.cli.main import main
from services.processes.export import export, sampled
from storage.errors import UnsupportedScan
from storage.maps import NO_MAP
from storage.packed.packed import PackedFile
from tests.packed_files import Case, write_arrays
from tests.programs_of_others import complaints_of_gltf_validator, read_by_splat_transform
from tests.reference_packed import decode_ellipsoid, decode_patch, decode_position
from tests.scenes import Dictionary, Settings, build_scene, camera_looking, coded, random_dictionary, sheet

MAPS = Path(__file__).parents[2] / "golden" / "maps.splatpress"
UTM = (450000.25, 5400000.5, 100.0)


def scene_of(n=300, turns=1, up=(0, 0, 1)):
    """Discs, discs with cliplines and ellipsoids, with atoms in turns, in large coordinates."""
    rng = np.random.default_rng(5)
    axes = np.tile(np.diag([0.12, 0.06, 0.03])[[0, 2, 1]], (n, 1, 1))
    axes[rng.random(n) < 0.8] = np.nan
    line = np.tile([0.8, 0.6, 0.1], (n, 1))
    line[(rng.random(n) < 0.7) | ~np.isnan(axes[:, 0, 0])] = np.nan
    plain = random_dictionary(rng)
    dictionary = Dictionary(plain.atoms, plain.scale, plain.weight_levels, n_turns=turns)
    splats = sheet(rng, n, axes=axes, clipline=line, **coded(rng, n, 20 * turns))
    splats = replace(splats, position=splats.position + UTM)
    return build_scene(splats, Settings(radius=0.1, origin=UTM, up=up), dictionary)


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    scene = scene_of(turns=8)
    return write_arrays(scene.header, scene.arrays, tmp_path_factory.mktemp("packed") / "scene.splatpress")


@pytest.fixture(scope="module")
def scene(packed):
    with PackedFile(packed) as opened:
        return opened.load()


def test_cloud__has_the_geometry_of_the_file(scene):
    cloud = cloud_of(scene)
    for i in (0, 5, 128, 299):
        np.testing.assert_allclose(cloud.position[i], decode_position(scene, i), atol=1e-12)
        axes = decode_ellipsoid(scene, i)
        assert cloud.solid[i] == (axes is not None)
        if axes is not None:
            np.testing.assert_allclose(cloud.axes[i], axes, rtol=1e-6)
    assert 0 < cloud.solid.sum() < len(cloud)


def test_cloud__takes_the_colour_of_the_middle_of_the_patch(scene):
    cloud = cloud_of(scene)
    at = (np.arange(32) + 0.5) / 16 - 1
    window = np.exp(-(at[:, None] ** 2 + at**2) / (2 * WINDOW_IN_RADII**2))
    for i in (0, 3, 77, 200, 299):
        expected = np.einsum("ij,ijc->c", window / window.sum(), decode_patch(scene, i)).clip(0, 1)
        np.testing.assert_allclose(cloud.color[i], expected, atol=1e-6)


def test_samples__are_the_texture_at_places_of_the_disc(scene):
    cloud = cloud_of(scene)
    samples = samples_of(scene, cloud, 12)
    per_splat = len(samples) // len(cloud)
    assert per_splat == 12
    for i in (3, 77, 299):
        patch = decode_patch(scene, i, 4).clip(0, 1)
        for j in range(per_splat):
            k = i * per_splat + j
            offset = samples.position[k] - cloud.position[i]
            x, y = (offset @ axis / (axis @ axis) for axis in cloud.axes[i, :2])
            row, column = round((y + 1) * 2 - 0.5), round((x + 1) * 2 - 0.5)
            np.testing.assert_allclose([x, y], [(column + 0.5) / 2 - 1, (row + 0.5) / 2 - 1], atol=1e-9)
            np.testing.assert_allclose(samples.color[k], patch[row, column], atol=1e-6)


def test_gaussians__reach_along_the_axes_of_their_splats(scene):
    cloud = cloud_of(scene)
    gaussians = gaussians_of(cloud)
    turned = Rotation.from_quat(gaussians.rotation).as_matrix() * gaussians.sigma[:, None]  # columns
    for axis in range(2):
        np.testing.assert_allclose(turned[:, :, axis], SIGMA_IN_RADII * cloud.axes[:, axis], atol=1e-9)
    lengths = np.linalg.norm(turned[:, :, 2], axis=1)
    np.testing.assert_allclose(lengths[~cloud.solid], FLATNESS * SIGMA_IN_RADII * 0.1)
    np.testing.assert_allclose(
        lengths[cloud.solid], SIGMA_IN_RADII * np.linalg.norm(cloud.axes[cloud.solid, 2], axis=1)
    )


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0, -1, 0), (3, -2, 5)])
def test_to_y_up__turns_up_to_y(up):
    np.testing.assert_allclose(to_y_up(np.array(up)).apply(np.array(up) / np.linalg.norm(up)), [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize("format", FORMATS)
def test_export__same_file_same_bytes_and_nothing_else_beside_it(packed, format, tmp_path):
    made = [export(packed, format, tmp_path / name / f"scene{FORMATS[format].suffix}") for name in ("a", "b")]
    assert made[0].path.read_bytes() == made[1].path.read_bytes()
    assert [made[0].path] == list((tmp_path / "a").iterdir())
    assert made[0].n_bytes == made[0].path.stat().st_size


@pytest.mark.parametrize("format", FORMATS)
def test_export__says_what_it_loses(packed, scene, format, tmp_path):
    lost = " ".join(export(packed, format, tmp_path / "out").lost)
    if FORMATS[format].kind in (PAGE, PACKED):
        assert lost == ""  # it has the file itself
        return
    n_lines = int((scene.rows.clipline >= 0).sum())
    assert f"cliplines of {n_lines:,} splats" in lost
    assert f"textures of {(scene.n_atoms > 0).sum():,} of 300 splats" in lost
    assert ("shapes of" in lost) == (FORMATS[format].kind == POINTS)
    assert ("450000.25" in lost) == (FORMATS[format].kind != POINTS)


def test_ply__points_open_in_plyfile(packed, scene, tmp_path):
    from plyfile import PlyData

    export(packed, "ply", tmp_path / "a.ply")
    rows, cloud = PlyData.read(tmp_path / "a.ply")["vertex"], cloud_of(scene)
    read = np.column_stack([rows[axis] for axis in "xyz"])
    assert read.dtype == np.float64 and np.array_equal(read, cloud.position + UTM)
    np.testing.assert_allclose(np.column_stack([rows[n] for n in ("nx", "ny", "nz")]), cloud.normal, atol=1e-6)
    np.testing.assert_allclose(
        np.column_stack([rows[n] for n in ("red", "green", "blue")]), 255 * cloud.color, atol=0.5
    )
    np.testing.assert_allclose(rows["radius"], cloud.radius, rtol=1e-6)
    textured = export(packed, "ply", tmp_path / "b.ply", samples="12")
    assert PlyData.read(tmp_path / "b.ply")["vertex"].count == textured.n_elements == 12 * len(cloud)


@pytest.mark.parametrize("format", ["las", "laz"])
def test_las__points_open_in_laspy(packed, scene, format, tmp_path):
    export(packed, format, tmp_path / f"a.{format}")
    las, cloud = laspy.read(tmp_path / f"a.{format}"), cloud_of(scene)
    np.testing.assert_allclose(np.column_stack([las.x, las.y, las.z]), cloud.position + UTM, atol=1e-6)
    np.testing.assert_allclose(np.column_stack([las.red, las.green, las.blue]), 65535 * cloud.color, atol=1)
    np.testing.assert_allclose(np.column_stack([las.normal_x, las.normal_y, las.normal_z]), cloud.normal, atol=1e-6)
    np.testing.assert_allclose(las["radius"], cloud.radius, rtol=1e-6)


def expected_columns(gaussians):
    return {
        **{axis: gaussians.position[:, i] for i, axis in enumerate("xyz")},
        **{f"f_dc_{i}": gaussians.dc[:, i] for i in range(3)},
        **{f"scale_{i}": np.log(gaussians.sigma[:, i]) for i in range(3)},
        "opacity": np.full(len(gaussians), np.log(OPACITY / (1 - OPACITY))),
    }


@pytest.mark.parametrize(
    ("format", "position", "color", "scale"),
    [("3dgs-ply", 1e-6, 1e-6, 1e-6), ("sog", 3e-5, 0.51, 0.02), ("spz", 2e-4, 0.95, 0.04)],
)
def test_gaussians__open_in_splat_transform(packed, scene, format, position, color, scale, tmp_path):
    export(packed, format, tmp_path / f"a{FORMATS[format].suffix}", samples="1")
    names, rows = read_by_splat_transform(tmp_path / f"a{FORMATS[format].suffix}")
    gaussians = gaussians_of(cloud_of(scene))
    if format == "spz":  # it stands y up; splat-transform turns it to trainers' axes, y down
        gaussians = replace(
            gaussians, position=(gaussians.position @ to_y_up(np.array([0, 0, 1.0])).as_matrix().T) * [1, -1, -1]
        )
    read = dict(zip(names, np.array(rows).T, strict=True))
    tolerances = {"x": position, "f": color / 255 / SH_0, "s": scale, "o": 0.3}
    for name, expected in expected_columns(gaussians).items():
        np.testing.assert_allclose(
            read[name], expected, atol=tolerances["x" if name in "xyz" else name[0]], err_msg=name
        )
    rotation = Rotation.from_quat(np.column_stack([read[f"rot_{i}"] for i in (1, 2, 3, 0)]))
    if format != "spz":
        assert (rotation.inv() * Rotation.from_quat(gaussians.rotation)).magnitude().max() < 0.02


def test_gaussians__of_textures_open_in_splat_transform(packed, scene, tmp_path):
    """Twelve a splat, each a third as large, with the colours that its texture has there."""
    made = export(packed, "3dgs-ply", tmp_path / "a.ply", samples="12")
    names, rows = read_by_splat_transform(tmp_path / "a.ply")
    read, samples = dict(zip(names, np.array(rows).T, strict=True)), samples_of(scene, cloud_of(scene), 12)
    assert made.n_elements == len(rows) == len(samples) == 12 * 300 and "samples of them" in " ".join(made.lost)
    np.testing.assert_allclose(np.column_stack([read[axis] for axis in "xyz"]), samples.position, atol=1e-5)
    color = np.column_stack([read[f"f_dc_{i}"] for i in range(3)]) * SH_0 + 0.5
    np.testing.assert_allclose(color, samples.color, atol=1e-5)
    discs = ~samples.solid
    np.testing.assert_allclose(np.exp(read["scale_0"])[discs], SIGMA_IN_RADII * SAMPLE_RADIUS[4] * 0.1, rtol=1e-4)


def test_gaussians__of_contrast_are_four_a_splat_in_their_colours(tmp_path, monkeypatch):
    """Another lies behind each. Colours are fitted to the file's own pictures, from cameras that textured splats; the
    loss is told in dB. A file that would have too many has one a splat, and says so."""
    rng = np.random.default_rng(9)
    cameras = [camera_looking((x, -2.0, 0.3), (0.0, 0.0, 0.0), (96, 72), name=str(x)) for x in (0.4, -0.4, 9.0)]
    splats = sheet(rng, 300, tilt=0.1, camera=np.arange(300) % 2, **coded(rng, 300, 20))
    scene = build_scene(splats, Settings(radius=0.08, cameras=tuple(cameras)), random_dictionary(rng))
    path = write_arrays(scene.header, scene.arrays, tmp_path / "a.splatpress")
    cloud = sampled(scene, cloud_of(scene), GAUSSIANS, AUTO, fit=0)[0]
    counts = np.unique(np.round(cloud.radius / cloud.radius.max(), 6), return_counts=True)[1]
    assert counts[1] + counts[0] // 4 == 300 and counts[0] % 4 == 0 and min(counts) > 20
    made = [export(path, "3dgs-ply", tmp_path / f"{fit}.ply", fit=fit) for fit in (0, 3)]
    assert made[0].n_elements == len(cloud) and made[1].n_elements == len(cloud) + 300
    assert "cameras are" not in " ".join(made[0].lost)
    after, before = re.search(
        "from 2 of its cameras .* ([0-9.]+) dB .* ([0-9.]+) dB before", str(made[1].lost)
    ).groups()
    assert float(after) > float(before) + 1
    again = export(path, "3dgs-ply", tmp_path / "again.ply")
    assert again.path.read_bytes() == made[1].path.read_bytes() != made[0].path.read_bytes()
    assert export(path, "3dtiles", tmp_path / "a.zip").n_elements == len(cloud) + 300
    monkeypatch.setattr("services.processes.export.MOST_FITTED", len(cloud) + 299)
    few = export(path, "3dgs-ply", tmp_path / "few.ply")
    assert few.n_elements == 300 and f"{len(cloud) + 300:,} would be more than" in " ".join(few.lost)


def test_glb__passes_the_validator_and_opens_in_pygltflib(packed, scene, tmp_path):
    import pygltflib

    export(packed, "glb", tmp_path / "a.glb", samples="1")
    complaints = complaints_of_gltf_validator(tmp_path / "a.glb")
    strange = [
        c for c in complaints if c["code"] != "UNSUPPORTED_EXTENSION" and "KHR_gaussian_splatting:" not in c["pointer"]
    ]
    assert not strange
    document, gaussians = pygltflib.GLTF2().load(str(tmp_path / "a.glb")), gaussians_of(cloud_of(scene))
    view = document.bufferViews[document.accessors[0].bufferView]
    read = np.frombuffer(document.binary_blob(), "<f4", 900, view.byteOffset).reshape(300, 3)
    np.testing.assert_allclose(read, gaussians.position, atol=1e-6)
    assert document.nodes[0].extras == {"origin": list(UTM), "unit": "metre"}
    np.testing.assert_allclose(Rotation.from_quat(document.nodes[0].rotation).apply([0, 0, 1]), [0, 1, 0], atol=1e-12)


def test_glb__has_what_the_extension_asks_for(packed, tmp_path):
    export(packed, "glb", tmp_path / "a.glb")
    data = (tmp_path / "a.glb").read_bytes()
    magic, version, length, n_json, _ = struct.unpack_from("<4s4I", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    document = json.loads(data[20 : 20 + n_json])
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0 and primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    kinds = {name.split(":")[-1]: document["accessors"][i]["type"] for name, i in primitive["attributes"].items()}
    assert kinds == {
        "POSITION": "VEC3",
        "ROTATION": "VEC4",
        "SCALE": "VEC3",
        "OPACITY": "SCALAR",
        "SH_DEGREE_0_COEF_0": "VEC3",
        "COLOR_0": "VEC4",
    }


def test_export__refuses_what_it_cannot(packed, tmp_path):
    with pytest.raises(UnsupportedScan, match="obj.*ply, las"):
        export(packed, "obj", tmp_path / "a.obj")
    for format in ("html",):
        with pytest.raises(
            UnsupportedScan, match=f"{format} with textures.*ply, las, laz, 3dgs-ply, spz, sog, glb, 3dtiles"
        ):
            export(packed, format, tmp_path / "a", samples="12")
    assert not list(tmp_path.iterdir())


def test_export__of_colours_alone_loses_no_textures_and_has_none(tmp_path):
    scene = build_scene(sheet(np.random.default_rng(1), 50))
    path = write_arrays(scene.header, scene.arrays, tmp_path / "a.splatpress")
    assert export(path, "ply", tmp_path / "a.ply").lost == ()
    with pytest.raises(UnsupportedScan, match="no atoms.*points without textures"):
        export(path, "ply", tmp_path / "b.ply", samples="12")
    assert not (tmp_path / "b.ply").exists()


def test_export__says_that_maps_of_stations_are_lost(tmp_path):
    lost = " ".join(export(MAPS, "glb", tmp_path / "a.glb").lost)
    with PackedFile(MAPS) as opened:
        scene = opened.load()
    n_mapped = int((scene.arrays["station"] != NO_MAP).sum())
    assert n_mapped > 0 and f"textures of {n_mapped:,} of {scene.header.n_finest:,} splats, looked up in 2 maps" in lost


def test_export__from_the_command_line(packed, tmp_path, capsys):
    assert main(["export", str(packed), "--to", "las", "--out", str(tmp_path / "a.las"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["path"] == str(tmp_path / "a.las") and found["n_elements"] == 300 and found["lost"]
    assert main(["export", str(packed), "--to", "las", "--out", str(tmp_path / "a.las")]) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert main(["export", str(packed), "--to", "las", "--out", str(tmp_path / "a.las"), "-w"]) == 0
    assert "loses" in capsys.readouterr().out


def test_export__of_a_single_splat(tmp_path):
    scene = build_scene(sheet(np.random.default_rng(1), 1))
    path = write_arrays(scene.header, scene.arrays, tmp_path / "a.splatpress")
    for format, known in FORMATS.items():
        assert export(path, format, tmp_path / f"a{known.suffix}").n_elements == 1


def test_export__cases_of_the_packed_format(tmp_path):
    from tests.packed_files import write_packed_file

    for i, case in enumerate(
        (
            Case(color_step=112, atom_counts=(0, 5, 16), n_ranks=16),
            Case(atom_size=8, n_turns=8, dictionary_bits=12, cliplines=True),
            Case(coarsest_size=32, ellipsoids=True),
        )
    ):
        path = write_packed_file(case, tmp_path / f"{i}.splatpress")
        assert export(path, "ply", tmp_path / f"{i}.ply", samples="12").n_elements == 12 * 300
