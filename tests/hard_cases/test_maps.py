"""Laser scans that are hard to texture from what their stations saw. Bounds: docs/NUMERICS.md."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import settings_for
from pipeline.stages.maps.panoramas import read_map
from pipeline.stages.maps.resample_maps import LEAST_SHARE
from pipeline.texture.resample import PATCH_DIM
from services.flow.code import resample
from services.flow.prepare import Prepared, prepare
from services.flow.run import Run
from storage.work import arrays
from tests.pipeline.execution.test_stage import Heard
from tests.stations import HALF, Seen, room_color, scanned, write_e57

STEP = 2.0  # degrees: coarse against the waves of the walls, so that colours are known to some tens of levels


def joined(*parts: Seen) -> Seen:
    return Seen(
        parts[0].centre, *(np.concatenate([getattr(p, f) for p in parts]) for f in ("position", "normal", "color"))
    )


def only(seen: Seen, rows: np.ndarray) -> Seen:
    return Seen(seen.centre, seen.position[rows], seen.normal[rows], seen.color[rows])


def patches_of(folder: Path, *stations: Seen) -> tuple[Prepared, dict, np.ndarray, np.ndarray]:
    """The scan with maps, what resampling says, its patches (n, 1024, 3), and where splats lie (n, 3), absolute."""
    scan = write_e57(folder / "scan.e57", *stations)
    run = Run(folder / "work", SerialExecutor(), Heard())
    run.work.mkdir()
    prepared = prepare(run, scan, None, settings_for("draft", texture="atoms").asked_effects)
    patches = resample(run, prepared)
    texel = arrays.read(patches.folder, "texel").reshape(-1, PATCH_DIM // 3, 3).astype(float)
    position = arrays.read(prepared.partition.folder, "position") + prepared.sources.origin
    assert np.isfinite(arrays.read(patches.folder, "energy")).all()
    return prepared, patches.summary, texel, position


def off_own_color(prepared: Prepared, texel: np.ndarray) -> np.ndarray:
    """How far each patch's middle is from the splat's own colour, in levels."""
    own = arrays.read(prepared.partition.folder, "color").astype(float)
    middle = texel.reshape(-1, 32, 32, 3)[:, 15:17, 15:17].mean(axis=(1, 2))
    return np.abs(middle - own).max(axis=1)


def test_maps__one_station_has_no_light_to_solve_and_shows_its_own_colours(tmp_path):
    prepared, found, texel, _ = patches_of(tmp_path, scanned([0.2, 0.1, 0.0], STEP))
    assert prepared.maps.light is None and prepared.maps.log_gain == ((0.0, 0.0, 0.0),)
    assert found.n_blind < 0.01 * len(texel)
    assert np.quantile(off_own_color(prepared, texel), 0.9) < 40


def test_maps__stations_without_overlap_keep_their_own_light_and_colours(tmp_path):
    near = scanned([0.2, 0.1, 0.0], STEP)
    far = scanned([0.2, 0.1, 0.0], STEP, gain=0.5)
    far = Seen(far.centre + [100, 0, 0], far.position + [100, 0, 0], far.normal, far.color)
    prepared, found, texel, _ = patches_of(tmp_path, near, far)
    assert prepared.maps.light.n_splats == 0 and prepared.maps.log_gain == ((0.0,) * 3,) * 2
    assert found.n_other_station == 0
    assert np.quantile(off_own_color(prepared, texel), 0.9) < 40


def test_maps__all_points_on_one_side_leave_the_rest_of_the_map_empty(tmp_path):
    seen = scanned([0.0, 0.0, 0.0], STEP, pillar=False)
    prepared, found, texel, _ = patches_of(tmp_path, only(seen, seen.position[:, 0] > 2.5))
    alpha = read_map(prepared.maps.folder, 0).color[..., 3] > 0
    assert 0.05 < alpha.mean() < 0.3
    assert found.n_blind < 0.01 * len(texel)


def test_maps__a_station_inside_an_object_is_counted_and_the_room_is_textured_where_it_is_seen(tmp_path):
    """A cap around the scanner, of splats larger than their distance, which would cover half of the map."""
    seen = scanned([0.0, 0.0, 0.0], STEP, pillar=False)
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(40, 3))
    direction[:, 2] = -np.abs(direction[:, 2])
    cap = 0.002 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    touching = np.zeros((3, 3))  # the scanner's own centre
    inside = np.concatenate([cap, touching])
    object_ = Seen(seen.centre, inside, np.tile([0.0, 0, 1], (43, 1)), np.full((43, 3), 255, np.uint8))
    prepared, found, texel, position = patches_of(tmp_path, joined(seen, object_))
    of_room = np.linalg.norm(position, axis=1) > 1
    above = of_room & (position[:, 2] > 0.2)
    is_flat = (texel == texel[:, :1]).all(axis=(1, 2))  # of those without a map: their one colour
    assert is_flat[above].mean() < 0.02 and found.n_blind < 0.5 * len(texel)
    assert np.quantile(off_own_color(prepared, texel)[above], 0.9) < 50


def test_maps__a_mirror_s_room_is_textured_from_the_station_that_saw_it(tmp_path):
    """Station 0 sees, through a mirror on the wall y = 2.5, points that lie behind that wall; station 1 saw the wall
    itself there, 40 levels brighter, and must not colour them."""
    first, second = scanned([-1.0, 0.0, 0.0], STEP, pillar=False), scanned([1.0, 0.0, 0.0], STEP, pillar=False)
    mirror = (np.abs(first.position[:, 1] - HALF[1]) < 1e-6) & (np.abs(first.position[:, 0] + 1) < 0.6)
    ray = first.position[mirror] - first.centre
    beyond = first.centre + ray * 1.6
    seen_in_it = Seen(first.centre, beyond, -np.tile([0.0, 1, 0], (len(ray), 1)), np.full((len(ray), 3), 30, np.uint8))
    prepared, found, texel, position = patches_of(tmp_path, joined(only(first, ~mirror), seen_in_it), second)
    inside = position[:, 1] > HALF[1] + 0.5
    assert inside.sum() == mirror.sum()
    off = np.abs(texel[inside] - 30).max(axis=(1, 2))
    assert (off > 40).mean() < 0.03


def test_maps__what_is_seen_through_glass_is_not_coloured_by_the_pane(tmp_path):
    """A pane that returns every ninth ray, in front of a wall that the others reach."""
    seen = scanned([0.0, 0.0, 0.0], 1.0, pillar=False)
    window = (np.abs(seen.position[:, 0] - HALF[0]) < 1e-6) & (np.abs(seen.position[:, 1:]) < 0.8).all(axis=1)
    rows = np.flatnonzero(window)
    pane = rows[::9]
    position, color = seen.position.copy(), seen.color.copy()
    position[pane] *= 0.6
    color[pane] = 255
    glazed = Seen(seen.centre, position, seen.normal, color)
    prepared, found, texel, at = patches_of(tmp_path, glazed)
    wall = (np.abs(at[:, 0] - HALF[0]) < 1e-6) & (np.abs(at[:, 1:]) < 0.7).all(axis=1)
    expected = room_color(at[wall])
    middle = texel[wall].mean(axis=1)
    assert (np.abs(middle - expected).max(axis=1) > 40).mean() < 0.05


def test_maps__splats_that_no_map_shows_have_their_own_colour(tmp_path):
    """Points far behind the walls, with no station of their own among those that see anything there."""
    seen = scanned([0.0, 0.0, 0.0], STEP, pillar=False)
    hidden = Seen(
        seen.centre, seen.position[::10] * 3, seen.normal[::10], np.full((len(seen.position[::10]), 3), 77, np.uint8)
    )
    prepared, found, texel, position = patches_of(tmp_path, joined(seen, hidden))
    behind = np.abs(position[:, 0]) > 2 * HALF[0]
    assert prepared.on_maps(prepared.maps.folder).n_stations == 1 and LEAST_SHARE < 0.1
    assert behind.any() and (texel[behind] == 77).all() and found.n_blind >= behind.sum()


@pytest.mark.parametrize("levels", [255, 65535])
def test_maps__colours_of_16_bits_make_the_map_of_their_8(tmp_path, levels):
    """An E57 says what its white is: the map is that of the same colours in 8 bits."""
    import pye57

    seen = scanned([0.0, 0.0, 0.0], 4.0)
    file = pye57.E57(str(tmp_path / "scan.e57"), mode="w")
    data = {f"cartesian{axis}": seen.position[:, k] for k, axis in enumerate("XYZ")}
    scale = levels // 255
    data |= {f"color{n}": seen.color[:, k].astype(np.int64) * scale for k, n in enumerate(("Red", "Green", "Blue"))}
    file.write_scan_raw(data, rotation=np.array([1.0, 0, 0, 0]), translation=np.zeros(3))
    file.close()
    run = Run(tmp_path / "work", SerialExecutor(), Heard())
    run.work.mkdir()
    prepared = prepare(run, tmp_path / "scan.e57", None, settings_for("draft", texture="atoms").asked_effects)
    color = arrays.read(prepared.partition.folder, "color")
    order = arrays.read(prepared.partition.folder, "point")
    np.testing.assert_array_equal(color, seen.color[order])
    assert read_map(prepared.maps.folder, 0).color[..., :3].max() > 200
