"""Paths: through their poses, with rotations that are some; and what a frame of them wants."""

import json

import numpy as np
import pytest

from renderer.residency.labels import NEIGHBOURS, smoothed_labels
from renderer.residency.paths import NAMES, Path90, made_paths, path_json, pose_of, read_path, through
from renderer.residency.places import Pose, Screen, places_of
from renderer.residency.prediction import Motion, ahead, motion_at
from renderer.residency.simulate import POLICIES, rows_of_path
from storage.errors import InvalidScan
from storage.packed.schema import NO_CAMERA, Camera

EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
CAMERAS = tuple(
    Camera(f"{i}.jpg", 600, 400, 500.0, 500.0, 300.0, 200.0, EYE, (0.3 * i - 0.15, 0.0, 0.0)) for i in range(2)
)


@pytest.fixture(scope="module")
def wall():
    """Splats of a wall 4 units ahead of two photographs, each of a random one."""
    x, y = np.meshgrid(np.linspace(-1.5, 1.5, 60), np.linspace(-1.0, 1.0, 40))
    centre = np.stack([x.ravel(), y.ravel(), np.full(x.size, 4.0)], axis=1)
    normal = np.tile([0.0, 0.0, -1.0], (len(centre), 1))
    camera = np.random.default_rng(2).integers(0, 2, len(centre)).astype(np.uint16)
    return centre, normal, np.full(len(centre), 0.04), camera


def test_labels__agree_with_neighbours_and_leave_splats_without_a_camera(wall):
    centre, normal, radius, camera = wall
    camera = camera.copy()
    camera[:5] = NO_CAMERA
    label = smoothed_labels(centre, normal, radius, camera, CAMERAS)
    assert (label[:5] == NO_CAMERA).all() and set(label[5:].tolist()) <= {0, 1}

    def salt(of) -> int:
        grid = of.reshape(40, 60)[1:]
        return int((grid[:, 1:] != grid[:, :-1]).sum() + (grid[1:] != grid[:-1]).sum())

    assert salt(label) < salt(camera) / 4


def test_labels__a_photograph_that_none_near_has_is_never_taken(wall):
    centre, normal, radius, _ = wall
    camera = np.where(np.arange(len(centre)) < len(centre) - NEIGHBOURS, 0, 1).astype(np.uint16)
    label = smoothed_labels(centre, normal, radius, camera, CAMERAS)
    assert (label[: len(centre) // 2] == 0).all()


def test_labels__a_photograph_never_spreads_over_what_something_hides_from_it(wall):
    """A post stands before the wall, and hides a strip of it from the first photograph, which all splats around
    have."""
    centre, normal, radius, _ = wall
    y = np.linspace(-1.0, 1.0, 60)
    post = np.array([(x, v, 2.0) for x in np.linspace(-0.04, 0.04, 3) for v in y])
    points = np.concatenate([centre, post])
    facing, size = np.tile([0.0, 0.0, -1.0], (len(points), 1)), np.append(radius, np.full(len(post), 0.03))
    hidden = np.abs((centre[:, 0] - 0.15) / 2) < 0.026  # where the ray from x = -0.15, the first one's, meets the post
    camera = np.append(np.where(hidden, 1, 0), np.zeros(len(post))).astype(np.uint16)
    label = smoothed_labels(points, facing, size, camera, CAMERAS)[: len(centre)]
    assert hidden.sum() > 50 and (label[hidden] == 1).all() and (label[~hidden] == 0).mean() > 0.8


def test_paths__the_four_are_rotations_and_the_same_pose_starts_and_ends_walks():
    paths = made_paths(CAMERAS[0], 4.0, np.array([0.0, -1.0, 0.0]))
    assert tuple(paths) == NAMES
    for path in paths.values():
        turns = np.stack([pose.rotation for pose in path.poses])
        assert np.allclose(turns @ turns.transpose(0, 2, 1), np.eye(3)) and (np.linalg.det(turns) > 0).all()
    assert paths["forward"].poses == paths["backward"].poses[::-1]


def test_paths__a_file_is_read_as_it_was_written_and_others_are_refused(tmp_path):
    keys = (pose_of(CAMERAS[0]), Pose(made_paths(CAMERAS[0], 4.0)["look_around"].poses[100].rotation, np.ones(3)))
    path = through("two", keys, 0.5)
    assert len(path.poses) == 45 and np.allclose(path.poses[-1].rotation, keys[1].rotation)
    (tmp_path / "two.json").write_text(json.dumps(path_json(path)))
    again = read_path(tmp_path / "two.json")
    assert again.name == "two"
    assert all(np.array_equal(a.centre, b.centre) for a, b in zip(again.poses, path.poses, strict=True))
    row = path_json(path)["poses"][0]
    for wrong in ("", "[]", '{"poses": []}', {"poses": [row]}, {"poses": [row, row | {"centre": [0, 0]}]},
                  {"poses": [row, row | {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}]}):  # fmt: skip
        (tmp_path / "wrong.json").write_text(wrong if isinstance(wrong, str) else json.dumps(wrong))
        with pytest.raises(InvalidScan):
            read_path(tmp_path / "wrong.json")


def test_prediction__at_constant_velocity_the_pose_ahead_is_the_one_that_comes():
    poses = through("p", (pose_of(CAMERAS[0]), Pose(np.eye(3), np.array([1.0, 0.5, 0.0]))), 1.0).poses
    found = ahead(poses[10], motion_at(poses, 10, 90), 9 / 90)
    assert np.allclose(found.centre, poses[19].centre) and np.allclose(found.rotation, poses[19].rotation)
    assert np.allclose(
        ahead(poses[0], Motion(np.zeros(3), np.array([0.0, np.pi / 2, 0.0])), 1.0).rotation[0], [0, 0, 1]
    )


def test_simulation__prediction_misses_no_more_and_says_the_same_again(wall):
    centre, normal, radius, camera = wall
    places = places_of(centre, radius, normal, camera, CAMERAS, magnified=2, page_px=64)
    screen = Screen(160, 120, 80.0)
    assert places.seen(Pose(np.eye(3), np.zeros(3)), screen, 1).n_pixels > 1000
    path = made_paths(CAMERAS[0], 4.0)["look_around"]
    path = Path90("look_around", path.poses[:90])
    rows = rows_of_path(places, path, 4.0, ((2, 60),))
    assert [row.policy for row in rows[::4]] == list(POLICIES)
    by_prediction = {row.prediction: row.misses for row in rows if row.policy == "default"}
    assert by_prediction["frustum"].pixels <= by_prediction["nothing"].pixels
    assert by_prediction["nothing"].pixels > 0, "the path wants pages that were not there"
    assert rows == rows_of_path(places, path, 4.0, ((2, 60),))
