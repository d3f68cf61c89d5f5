"""Views: scaled photo cameras, orbits, and the numbers the shaders get."""

from dataclasses import replace

import numpy as np
import pytest

from renderer.splats.context import gl_context
from renderer.splats.projection import checked_view, split_floats, view_to_photo
from renderer.splats.views import bulk_of, framed_views, orbit_views, station_views, up_direction, view_of
from storage.errors import InvalidScan, ResourceExhausted
from tests.scenes import Settings, Splats, build_scene, camera_looking, sheet


def project(camera, point):
    x, y, z = np.array(camera.rotation) @ np.subtract(point, camera.centre)
    return np.array([camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px])


def test_view_of__scales_every_projection_with_the_picture():
    camera = camera_looking((0, -3, 1), (0, 0, 0), (640, 400), (500, 520))
    view = view_of(camera, (320, 100))
    point = (0.3, 0.2, -0.1)
    assert project(view, point) == pytest.approx(project(camera, point) * [0.5, 0.25])
    assert view_of(camera) == camera


def test_station_views__look_along_up_where_the_scan_lies_there():
    """As a depth camera's own points do, whose third axis is where it looked."""
    splats = sheet(np.random.default_rng(1), 128 * 8, half_width=0.2)
    position = splats.position - splats.position.mean(axis=0) + [0, 0, 2.0]
    scene = build_scene(Splats(position, splats.normal, splats.color), Settings())
    (view,) = station_views(scene, [(0.0, 0.0, 0.0)], (64, 48))
    assert (np.array(view.rotation) @ [0, 0, 2.0])[2] > 1.9
    assert np.abs(project(view, (0.0, 0.0, 2.0)) - [32, 24]).max() < 4


def scene_with_strays(cameras=()):
    rng = np.random.default_rng(0)
    splats = sheet(rng, 128 * 40, half_width=1.0)
    position = splats.position + [10, 20, 30]
    position[:150] += 500
    settings = Settings(origin=(9.0, 21.0, 30.0), cameras=cameras)
    return build_scene(Splats(position, splats.normal, splats.color), settings)


def test_bulk_of__is_not_spoilt_by_strays():
    low, high = bulk_of(scene_with_strays())
    assert low.min(axis=0) == pytest.approx([0, -1, -1], abs=0.2)
    assert high.max(axis=0) == pytest.approx([2, -1, 1], abs=0.2)


def test_orbit_views__of_a_long_scene_fill_the_picture_from_the_side_and_see_all_of_it_from_everywhere():
    rng = np.random.default_rng(0)
    splats = sheet(rng, 128 * 40, half_width=1.0)
    position = splats.position * [8, 1, 1]
    scene = build_scene(Splats(position, splats.normal, splats.color), Settings())
    for size in ((400, 300), (300, 400), (200, 200)):
        seen = [np.array([project(view, p) for p in position[::7]]) for view in orbit_views(scene, 8, size)]
        assert all((p > 0).all() and (p < size).all() for p in seen)
        assert max(np.ptp(p[:, 0]) / size[0] for p in seen) > 0.8
    distances = [np.linalg.norm(view.centre) for view in orbit_views(scene, 5, (400, 300))]
    assert np.ptp(distances) < 0.1


@pytest.mark.parametrize("up", [(0, 1, 0), (1, 0, 0), (0, 0, -1), (1, 1, 1)])
def test_orbit_views__stand_upright_in_any_direction_that_is_asked_for(up):
    for view in orbit_views(scene_with_strays(), 4, (120, 80), up):
        middle = np.array([10, 20, 30])
        assert project(view, middle) == pytest.approx([60, 40], abs=6)
        above = project(view, middle + 0.3 * np.array(up) / np.linalg.norm(up))
        assert above[1] < project(view, middle)[1] and above[0] == pytest.approx(project(view, middle)[0], abs=2)


def test_orbit_views__stand_around_the_scene_and_look_down_at_it():
    views = orbit_views(scene_with_strays(), 6, (120, 80))
    centres = np.array([view.centre for view in views])
    assert len(views) == 6 and len({view.name for view in views}) == 6
    assert np.ptp(np.linalg.norm(centres - centres.mean(axis=0), axis=1)) < 1e-9
    assert centres.mean(axis=0)[2] > 30
    for view in views:
        assert project(view, (10, 20, 30)) == pytest.approx([60, 40], abs=6)
        assert project(view, (10, 20, 30.5))[1] < project(view, (10, 20, 30))[1]
        assert np.linalg.det(view.rotation) == pytest.approx(1)
        corners = [project(view, (10 + x, 20, 30 + z)) for x in (-0.9, 0.9) for z in (-0.9, 0.9)]
        assert (np.array(corners) > 0).all() and (np.array(corners) < [120, 80]).all()


@pytest.mark.parametrize("size", [(120, 80), (60, 200)])
def test_framed_views__hold_the_bulk_and_leave_no_more_room_than_they_must(size):
    scene = scene_with_strays()  # a chunk may hold both of the sheet and strays: its corner is spared
    for view, orbit in zip(framed_views(scene, 4, size), orbit_views(scene, 4, size)):
        px = np.array([project(view, (10 + x, 20, 30 + z)) for x in (-0.9, 0.9) for z in (-0.9, 0.9)])
        assert view.rotation == orbit.rotation and (px > 0).all() and (px < size).all()
        assert ((px.max(axis=0) - px.min(axis=0)) / size).max() > 0.5
        assert px.max(axis=0) + px.min(axis=0) == pytest.approx(np.array(size), rel=0.15)  # centred


def test_framed_views__of_one_point_stand_off_its_disc():
    one = build_scene(Splats(np.zeros((1, 3)), np.array([[0.0, 0, 1]]), np.zeros((1, 3))), Settings())
    for view in framed_views(one, 3, (120, 80)):
        assert 2 * one.header.radius < np.linalg.norm(view.centre) < 8 * one.header.radius


def test_orbit_views__begin_where_the_photographs_were_taken():
    camera = camera_looking((10, 15, 31), (10, 20, 30))
    first = orbit_views(scene_with_strays((camera,)), 3, (64, 64))[0]
    away = np.subtract(first.centre, (10, 20, 30))
    assert away[1] < -1 and abs(away[0]) < 0.3


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 3, 4), (-1, 0, 0), (1, 0, 0)])
def test_orbit_views__stand_upright_in_the_direction_that_is_asked_for(up):
    for view in orbit_views(scene_with_strays(), 5, (120, 80), up):
        assert np.linalg.det(view.rotation) == pytest.approx(1)
        higher = np.add((10, 20, 30), np.array(up) / np.linalg.norm(up) * 0.5)
        middle = project(view, (10, 20, 30))
        assert project(view, higher)[1] < middle[1] and project(view, higher)[0] == pytest.approx(middle[0], abs=6)


def test_up_direction__points_to_the_tops_of_the_photographs():
    upright = camera_looking((0, -3, 0), (0, 0, 0))
    hanging = replace(upright, rotation=tuple(map(tuple, (np.diag([-1, -1, 1]) @ upright.rotation).tolist())))
    assert up_direction(scene_with_strays((upright,)).header).tolist() == [0, 0, 1]
    assert up_direction(scene_with_strays((hanging,)).header).tolist() == [0, 0, -1]


def test_split_floats__keep_a_georeferenced_eye():
    value = np.array([4.5e5 + 0.123456789, 5.4e6 + 1e-6, -1e-9])
    high, low = split_floats(value)
    assert np.abs(high.astype(float) + low - value).max() < 1e-8


def test_view_to_photo__projects_as_the_photo_camera_does():
    view = camera_looking((1, -2, 0.5), (0, 0, 0))
    photo = camera_looking((5e6, -3.2, 0.1), (5e6 - 1, 0, 0), focal_px=(70, 85))
    view, photo = (replace(c, centre=tuple(np.add(c.centre, (5e6 if c is view else 0, 0, 0)))) for c in (view, photo))
    point = np.array([5e6 + 0.2, 0.1, -0.3])
    in_view = np.array(view.rotation) @ (point - view.centre)
    seen = view_to_photo(view, photo) @ [*in_view, 1]
    assert seen[:2] / seen[2] == pytest.approx(project(photo, point), abs=1e-5)


@pytest.mark.parametrize("change", [{"fx_px": np.nan}, {"fy_px": 0.0}, {"width_px": 0}, {"centre": (0, np.inf, 0)}])
def test_checked_view__refuses_what_has_no_picture(change):
    with pytest.raises(InvalidScan, match="camera 'view'"):
        checked_view(replace(camera_looking((0, -3, 0), (0, 0, 0)), **change))


def test_gl_context__says_what_to_install(monkeypatch):
    def no_context(**_):
        raise OSError("libEGL.so.1: cannot open shared object file")

    monkeypatch.setattr("moderngl.create_context", no_context)
    with pytest.raises(ResourceExhausted, match="libegl1 libgl1 libgl1-mesa-dri"):
        gl_context()
