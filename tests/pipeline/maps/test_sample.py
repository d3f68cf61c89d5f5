"""Patches from maps show what lies in the splat's square, and nothing of what hides it or lies behind its rim."""

import numpy as np
import pytest

from pipeline.maps.choice import NO_STATION, OWN_BONUS, best_stations, sharpness
from pipeline.maps.light import levels_with
from pipeline.maps.sample import Squares, fill, foreign_points, sample_patches, seen_at_centre
from pipeline.maps.station_map import MapFrame, StationMap, encode_distances
from storage.packed.schema import PATCH_SIZE
from tests.stations import cast, room_color, scanned


def ideal_map(centre, height: int = 400, pillar: bool = True, color=room_color) -> StationMap:
    """What a station with no noise sees: the walls' own distances and colours in every texel."""
    frame = MapFrame(0, tuple(centre), height, 0.1, 100.0)
    width, height = frame.projection.size
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).reshape(-1, 2)
    direction = frame.projection.unproject(pixels, np.ones(len(pixels))) - frame.centre
    point, _ = cast(np.array(centre, float), direction, pillar)
    rgba = np.full((len(point), 4), 255, np.uint8)
    rgba[:, :3] = np.rint(color(point))
    depth = encode_distances(np.linalg.norm(point - frame.centre, axis=1), frame)
    return StationMap(frame, rgba.reshape(height, width, 4), depth.reshape(height, width))


def squares_on(direction, centre, radius: float, pillar: bool = True) -> Squares:
    """Splats on the walls in these directions (n, 3)."""
    direction = np.atleast_2d(np.asarray(direction, float))
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    point, normal = cast(np.array(centre, float), direction, pillar)
    u = np.cross(normal, np.roll(normal, 1, axis=1))
    return Squares(point - centre, u, np.cross(normal, u), np.full(len(point), radius))


def texels_of(squares: Squares, i: int, centre) -> np.ndarray:
    """Where the texels of a patch lie, (PATCH_SIZE^2, 3)."""
    at = (np.arange(PATCH_SIZE) + 0.5) * 2 / PATCH_SIZE - 1
    x, y = (a.reshape(-1, 1) for a in np.meshgrid(at, at))
    r = squares.radius[i]
    return squares.centre[i] + r * (x * squares.u[i] + y * squares.v[i]) + centre


HARD = [[0, 0.02, 1], [0, 0, -1], [-1, 1e-9, 0.1], [-1, 0, 0], [1, -1e-9, -0.9], [0.5, -1, 0.75], [-0.4, -1, -0.9]]


def test_sample__patches_are_the_wall_s_own_colours_across_poles_seam_and_charts():
    centre = np.array([0.1, -0.3, 0.05])
    station_map, squares = ideal_map(centre), squares_on(HARD, centre, 0.06)
    patches, share = sample_patches(station_map, squares)
    assert share.min() == 1.0
    for i in range(len(HARD)):
        found = patches[i].reshape(-1, 3).astype(float)
        assert (
            np.abs(found - room_color(texels_of(squares, i, centre))).max() < 6
        )  # a texel is up to 1.6 cm of a wave of 50


def test_sample__texels_of_many_map_texels_are_their_mean():
    """One lookup would find the noise; a texel here covers 3 x 3 to 5 x 5 texels of the map."""
    rng = np.random.default_rng(3)
    centre = np.zeros(3)
    station_map = ideal_map(centre, 900, color=lambda p: 128 + 100 * rng.choice([-1, 1], (len(p), 1)).repeat(3, axis=1))
    patches, _ = sample_patches(station_map, squares_on([[1, 0.1, 0.1]], centre, 0.25, pillar=False))
    assert patches.std() < 60 < 100


def test_sample__what_hides_a_splat_has_no_part_in_its_patch():
    """A wall splat half of which the pillar hides: its patch goes on as the wall does, and its share says how much was
    seen."""
    centre = np.zeros(3)
    red_pillar = ideal_map(centre, color=lambda p: np.where(np.abs(p[:, :1]) > 2.9, [[0.0, 200, 0]], [[250.0, 0, 0]]))
    edge = np.array([[3.0, 3.0 * (0.4 - 0.25) / (1.2 + 0.25), 0.0]])  # behind the pillar's silhouette
    on_wall = Squares(edge, np.array([[0.0, 1, 0]]), np.array([[0.0, 0, 1]]), np.array([0.2]))
    patches, share = sample_patches(red_pillar, on_wall)
    assert 0.3 < share[0] < 0.7
    assert (patches[0, ..., 0] == 0).all() and (patches[0, ..., 1] == 200).all()


def test_sample__a_splat_that_the_map_does_not_show_has_no_share():
    centre = np.zeros(3)
    station_map = ideal_map(centre)
    behind = Squares(np.array([[2.6, 0.95, 0.0]]), np.array([[0.0, 1, 0]]), np.array([[0.0, 0, 1]]), np.array([0.05]))
    for squares in (behind, Squares(np.zeros((1, 3)), behind.u, behind.v, behind.radius)):
        patches, share = sample_patches(station_map, squares)
        assert share[0] == 0 and not patches.any() and not seen_at_centre(station_map, squares)[0]


def test_sample__void_around_a_splat_is_filled_from_what_is_there():
    centre = np.zeros(3)
    station_map = ideal_map(centre, pillar=False)
    keep = np.zeros(station_map.depth.shape, bool)
    pixels, _ = station_map.frame.projection.project(np.array([[3.0, 0.0, 0.0]]))
    column, row = pixels[0].astype(int)
    keep[row - 4 : row + 4, column : column + 3] = True
    thin = StationMap(
        station_map.frame,
        np.where(keep[..., None], [100, 150, 200, 255], 0).astype(np.uint8),
        np.where(keep, station_map.depth, 65535).astype(np.uint16),
    )
    patches, share = sample_patches(thin, squares_on([[1, 0.005, 0]], centre, 0.2, pillar=False))
    assert 0 < share[0] < 0.5
    np.testing.assert_array_equal(np.unique(patches[0].reshape(-1, 3), axis=0), [[100, 150, 200]])


def test_fill__keeps_what_is_known_and_stays_between_its_extremes():
    rng = np.random.default_rng(1)
    for n_known in (1, 5, 300):
        picture, known = rng.uniform(50, 90, (32, 32, 3)), np.zeros((32, 32), bool)
        known.ravel()[rng.choice(1024, n_known, replace=False)] = True
        before = picture.copy()
        fill(picture, known)
        np.testing.assert_array_equal(picture[known], before[known])
        assert picture.min() >= before[known].min() - 1e-9 and picture.max() <= before[known].max() + 1e-9


@pytest.mark.parametrize("gain", [0.5, 1.0, 1.7])
def test_levels__a_gain_is_of_linear_light(gain):
    levels = levels_with((np.log(gain), 0.0, 0.0))
    np.testing.assert_allclose(levels[:, 1], np.arange(256), atol=1e-9)
    linear = lambda v: np.where(v <= 0.04045 * 255, v / 255 / 12.92, ((v / 255 + 0.055) / 1.055) ** 2.4)
    below = linear(np.arange(256)) * gain < 1
    np.testing.assert_allclose(linear(levels[below, 0]), linear(np.arange(256)[below]) * gain, atol=1e-9)


def test_choice__the_sharpest_map_that_sees_the_splat_and_its_own_scanner_s_unless_another_is_much_sharper():
    stations = np.array([[-2.0, 0.0, 0.0], [1.9, -1.5, 0.0], [2.5, 1.8, 0.0]])
    maps = [ideal_map(c, 200) for c in stations]
    wall = squares_on([[1, -0.1, 0.05]], np.zeros(3), 0.05)  # all three may see it, the first from 5 m, the others near
    hidden = squares_on([[3.0, 0.7, 0.0]], np.zeros(3), 0.05, pillar=False)  # behind the pillar for the first
    fields = ("centre", "u", "v", "radius")
    found = Squares(*(np.concatenate([getattr(wall, f), getattr(hidden, f)]) for f in fields))

    def of(station_map: StationMap) -> Squares:
        return Squares(found.centre - station_map.frame.centre, found.u, found.v, found.radius)

    score = np.array([sharpness(m, of(m)) for m in maps])
    seen = np.array([seen_at_centre(m, of(m)) for m in maps])
    assert seen[1:, 0].any() and not seen[0, 1]
    own = np.zeros(2, np.int64)
    expected = np.where(seen, score * np.where(np.arange(3)[:, None] == 0, OWN_BONUS, 1), 0)
    best = best_stations(lambda i: maps[i], 3, of, own)
    assert best[0] == expected[:, 0].argmax() != 0
    assert best[1] == (expected[:, 1].argmax() if expected[:, 1].any() else 0)
    only_own = best_stations(lambda i: maps[0] if i == 0 else None, 3, of, own)
    assert only_own.tolist() == [0, 0], "what no map shows at its centre keeps its own station"
    nobody = best_stations(lambda i: None, 3, of, own)
    assert nobody.tolist() == [NO_STATION, NO_STATION]


def test_sample__a_drawn_map_serves_like_an_ideal_one():
    from tests.pipeline.maps.test_draw import drawn

    seen = scanned([0.1, -0.3, 0.05], 0.5)
    squares = squares_on(HARD, seen.centre, 0.06)
    patches, share = sample_patches(drawn(seen, 180), squares)
    assert share.min() > 0.99
    for i in range(len(HARD)):
        assert np.abs(patches[i].reshape(-1, 3) - room_color(texels_of(squares, i, seen.centre))).mean() < 6


def test_foreign__points_of_a_disc_over_a_silhouette_are_another_surface_s_and_those_over_void_nobody_s():
    centre = np.zeros(3)
    points = np.array([[0.0, 0.0], [0.8, 0.0], [-0.8, 0.0], [0.0, 0.8]])
    edge = np.array([[1.45, 0.15, 0.0]])  # of the pillar: the wall lies beyond it for smaller y
    on_edge = Squares(edge, np.array([[0.0, 1, 0]]), np.array([[0.0, 0, 1]]), np.array([0.1]))
    station_map = ideal_map(centre)
    # the pillar's face is at x = 0.95; the disc lies where its far corner is, so only what the ray meets there is its
    # own
    near = Squares(np.array([[0.95, 0.158, 0.0]]), on_edge.u, on_edge.v, np.array([0.1]))
    assert foreign_points(station_map, near, points).tolist() == [[False, False, True, False]]
    nothing = StationMap(station_map.frame, station_map.color, np.full_like(station_map.depth, 65535))
    assert foreign_points(nothing, near, points).all()
    around = Squares(np.zeros((1, 3)), on_edge.u, on_edge.v, np.array([1.0]))
    assert not foreign_points(station_map, around, points).any(), "of what surrounds the station the map says nothing"
