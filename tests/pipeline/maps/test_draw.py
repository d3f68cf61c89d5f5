"""Maps drawn from splats show the surfaces that the station saw, all around."""

import numpy as np
import pytest

from pipeline.maps.draw import NEAREST_RADII, draw_color, draw_depth, empty_canvas, finish
from pipeline.maps.station_map import NOTHING, MapFrame, decode_distances, encode_distances
from tests.stations import Seen, cast, room_color, scanned

HEIGHT = 90


def drawn(seen: Seen, height: int = HEIGHT, radius_steps: float = 1.2, pieces: int = 1):
    local = seen.position - seen.centre
    radius = radius_steps * np.pi / 2 / height * np.linalg.norm(local, axis=1)
    canvas = empty_canvas(height)
    parts = np.array_split(np.arange(len(local)), pieces)
    for rows in parts:
        draw_depth(canvas, local[rows], seen.normal[rows], radius[rows])
    for rows in parts:
        draw_color(canvas, local[rows], seen.normal[rows], radius[rows], seen.color[rows])
    return finish(canvas, 0, tuple(seen.centre.tolist()))


def directions_of_texels(frame: MapFrame) -> np.ndarray:
    width, height = frame.projection.size
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).reshape(-1, 2)
    return frame.projection.unproject(pixels, np.ones(len(pixels))) - frame.centre


def test_draw__every_direction_shows_the_surface_that_lies_there_poles_seam_and_charts_included():
    made = drawn(scanned([0.3, -0.2, 0.1]))
    assert (made.color[..., 3] == 255).all() and (made.depth != NOTHING).all()
    point, _ = cast(np.array(made.frame.centre), directions_of_texels(made.frame))
    distance = np.linalg.norm(point - made.frame.centre, axis=1)
    off = np.abs(decode_distances(made.depth, made.frame).ravel() / distance - 1)
    color = np.abs(made.color[..., :3].reshape(-1, 3) - room_color(point)).mean(axis=1)
    assert np.median(off) < 2e-3 and np.quantile(off, 0.95) < 0.02  # the rest lies at the pillar's edges
    assert np.median(color) < 4 and np.quantile(color, 0.9) < 12


def test_draw__what_hides_is_drawn_and_what_is_hidden_is_not():
    seen = scanned([0.0, 0.0, 0.0], pillar=False)
    behind = Seen(seen.centre, seen.position * 1.5, seen.normal, np.full_like(seen.color, 255))
    both = Seen(
        seen.centre,
        np.concatenate([behind.position, seen.position]),
        np.concatenate([behind.normal, seen.normal]),
        np.concatenate([behind.color, seen.color]),
    )
    np.testing.assert_array_equal(drawn(both).color, drawn(seen).color)


def test_draw__no_sample_is_lost_however_its_disc_lies():
    """Discs seen exactly from the side, and of no size: each has the texel that it falls into."""
    rng = np.random.default_rng(0)
    local = rng.normal(size=(300, 3))
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    normal = np.cross(local, rng.normal(size=(300, 3)))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    canvas = empty_canvas(HEIGHT)
    draw_depth(canvas, local, normal, np.full(300, 1e-9))
    draw_color(canvas, local, normal, np.full(300, 1e-9), np.full((300, 3), 200, np.uint8))
    made = finish(canvas, 0, (0.0, 0.0, 0.0))
    pixels, _ = made.frame.projection.project(local)
    column, row = pixels.astype(int).T
    assert (made.color[np.minimum(row, HEIGHT - 1), column] == [200, 200, 200, 255]).all()
    assert (made.color[..., 3] > 0).sum() < 5 * 300


@pytest.mark.parametrize("direction", [[0, 0, 1], [0, 0, -1], [-1, 0, 0], [1, -1e-9, 0], [1, 0, 1], [-1, -1e-9, -1]])
def test_draw__a_disc_across_a_pole_the_seam_or_a_chart_s_edge_is_whole(direction):
    """Its texels' solid angles add up to its own, 2 pi (1 - cos)."""
    centre = np.array(direction, float) / np.linalg.norm(direction)
    canvas = empty_canvas(360)
    draw_depth(canvas, centre[None], centre[None], np.array([0.2]))
    draw_color(canvas, centre[None], centre[None], np.array([0.2]), np.array([[9, 99, 199]], np.uint8))
    made = finish(canvas, 0, (0.0, 0.0, 0.0))
    covered = made.color[..., 3] > 0
    rows, columns = np.nonzero(covered)
    pixels = np.stack([columns, rows], axis=1) + 0.5
    projection = made.frame.projection
    at = projection.unproject(pixels, np.ones(len(pixels)))
    owned = np.abs(projection.project(at)[0] - pixels).max(axis=1) < 1e-6  # corners of caps show the band once more
    cap = 2 * np.pi * (1 - np.cos(np.arctan(0.2)))
    np.testing.assert_allclose(projection.footprint(pixels[owned]).sum(), cap, rtol=0.02)
    assert (made.color[covered] == [9, 99, 199, 255]).all()


def test_draw__a_splat_around_the_station_is_left_out_and_counted():
    seen = scanned([0.0, 0.0, 0.0], 4.0)
    canvas = empty_canvas(20)
    local = seen.position - seen.centre
    radius = np.full(len(local), 0.01)
    radius[:7] = np.linalg.norm(local[:7], axis=1) / NEAREST_RADII * 1.01
    assert draw_depth(canvas, local, seen.normal, radius) == 7
    zero = draw_depth(canvas, np.zeros((1, 3)), np.array([[0.0, 0, 1]]), np.array([0.01]))
    assert zero == 1


def test_draw__pieces_make_the_same_map_as_all_points_at_once():
    seen = scanned([0.2, 0.1, 0.0], 2.0)
    once, pieces = drawn(seen, 45), drawn(seen, 45, pieces=7)
    np.testing.assert_array_equal(once.color, pieces.color)
    np.testing.assert_array_equal(once.depth, pieces.depth)


def test_finish__a_map_of_nothing_is_empty():
    made = finish(empty_canvas(4), 2, (1.0, 2.0, 3.0))
    assert not made.color.any() and (made.depth == NOTHING).all() and made.frame.farthest > made.frame.nearest


def test_distances__are_off_by_half_a_step_at_most():
    frame = MapFrame(0, (0.0, 0.0, 0.0), 10, 0.3, 3000.0)
    distance = np.geomspace(0.3, 3000, 5000)
    back = decode_distances(encode_distances(distance, frame), frame)
    assert np.abs(np.log(back / distance)).max() <= 0.5 / frame.codes_an_e_fold * 1.0001
    assert np.abs(back / distance - 1).max() < 1e-4
    assert encode_distances(np.array([np.inf, np.nan]), frame).tolist() == [NOTHING, NOTHING]
    assert np.isinf(decode_distances(np.array([NOTHING]), frame)).all()
    assert MapFrame.from_json(frame.to_json()) == frame
