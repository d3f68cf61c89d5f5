"""The photo baseline against its slow twin."""

import numpy as np
import pytest

from renderer.splats.baseline import PhotoSplats
from renderer.splats.scene import GpuScene
from renderer.splats.views import view_of
from storage.errors import InvalidScan
from storage.packed.schema import NO_CAMERA
from tests.renderer.reference_renderer import agreement_db, psnr_db, render_baseline
from tests.scenes import Settings, Splats, build_scene, camera_looking, random_colors, sheet

ORIGIN = (4.5e5, 5.4e6, 100.0)


def smooth_photo(rng, size, cycles=0.5):
    y, x = np.meshgrid(np.arange(size[1]), np.arange(size[0]), indexing="ij")
    waves = [np.sin(x * a + y * b + c) for a, b, c in rng.uniform(-cycles, cycles, (3, 3))]
    return np.round(127 + 110 * np.stack(waves, axis=-1)).astype(np.uint8)


def photographed(rng, n=120, clipline=None, cycles=0.5):
    """A sheet, two photos of different sizes and focal lengths, and which splats each textures."""
    origin = np.array(ORIGIN)
    cameras = (
        camera_looking(origin + (0.4, -1.1, 0.3), origin, (96, 64), (80, 95), name="a"),
        camera_looking(origin + (-0.5, -1.4, -0.2), origin, (64, 128), (110, 90), name="b"),
    )
    plain = sheet(rng, n, tilt=0.3 if n > 25 else 0.01)
    camera = rng.choice([0, 1, NO_CAMERA], n, p=[0.45, 0.45, 0.1])
    splats = Splats(plain.position + origin, plain.normal, random_colors(rng, n), camera=camera, clipline=clipline)
    photos = [smooth_photo(rng, (c.width_px, c.height_px), cycles) for c in cameras]
    return build_scene(splats, Settings(origin=ORIGIN, radius=0.15, cameras=cameras)), photos


def drawn(renderer, scene, photos, view, **more):
    gpu_scene = GpuScene(scene, renderer.context)
    splats = PhotoSplats(gpu_scene, photos.__getitem__, **more)
    picture = renderer.render_baseline(splats, view)
    splats.release()
    gpu_scene.release()
    return picture


def test_baseline__takes_photographs_at_another_size_with_their_cameras(renderer):
    scene, photos = photographed(np.random.default_rng(0), cycles=0.1)
    view = camera_looking(np.add(ORIGIN, (0.1, -1.3, 0.2)), ORIGIN, (64, 48), (40, 36))
    half = [
        photo.reshape(photo.shape[0] // 2, 2, -1, 2, 3).mean(axis=(1, 3)).round().astype(np.uint8) for photo in photos
    ]
    cameras = [view_of(c, (c.width_px // 2, c.height_px // 2)) for c in scene.header.cameras]
    picture, smaller = drawn(renderer, scene, photos, view), drawn(renderer, scene, half, view, cameras=cameras)
    assert np.array_equal(picture.coverage, smaller.coverage) and psnr_db(picture.rgb / 255, smaller.rgb / 255) > 40


@pytest.mark.parametrize(("distance", "focal_px"), [(0.8, 60), (1.3, 40), (6.0, 60)])
def test_baseline__textures_splats_as_the_twin_does(renderer, distance, focal_px):
    scene, photos = photographed(np.random.default_rng(0))
    view = camera_looking(np.add(ORIGIN, (0.1, -distance, 0.2)), ORIGIN, (64, 48), (focal_px, 0.9 * focal_px))
    expected, covered = render_baseline(scene, photos, view)
    picture = drawn(renderer, scene, photos, view)
    assert covered.any() and (picture.coverage != covered).mean() < 1e-3
    assert agreement_db(picture.rgb, expected, lambda moved: render_baseline(scene, photos, moved)[0], view) >= 45


def test_baseline__stays_on_the_disc_where_a_splat_is_seen_almost_edge_on(renderer):
    scene, photos = photographed(np.random.default_rng(5), n=25, cycles=0.1)
    view = camera_looking(np.add(ORIGIN, (0.02, -0.06, 1.6)), ORIGIN, (80, 40), (80, 80), up=(0.0, -1.0, 0.0))
    expected, covered = render_baseline(scene, photos, view)
    picture = drawn(renderer, scene, photos, view)
    assert covered.mean() > 0.02
    assert agreement_db(picture.rgb, expected, lambda moved: render_baseline(scene, photos, moved)[0], view) >= 55


def test_baseline__cuts_at_cliplines(renderer):
    rng = np.random.default_rng(1)
    line = np.tile([0.8, 0.6, -0.1], (120, 1))
    line[::3] = np.nan
    scene, photos = photographed(rng, clipline=line)
    view = camera_looking(np.add(ORIGIN, (0.1, -1.0, 0.2)), ORIGIN)
    expected, _ = render_baseline(scene, photos, view)
    picture = drawn(renderer, scene, photos, view)
    assert agreement_db(picture.rgb, expected, lambda moved: render_baseline(scene, photos, moved)[0], view) >= 45
    assert "baseline clipline photo" in picture.programs


def test_baseline__shows_a_photo_again_from_its_own_camera(renderer):
    rng = np.random.default_rng(2)
    n = 400
    camera = camera_looking((0.1, -1.0, 0.05), (0, 0, 0), (90, 60), (100, 80))
    plain = sheet(rng, n, tilt=0.05)
    photo = smooth_photo(rng, (90, 60))
    scene = build_scene(Splats(plain.position, plain.normal, camera=np.zeros(n, int)), Settings(cameras=(camera,)))
    picture = drawn(renderer, scene, [photo], camera)
    assert picture.coverage.mean() > 0.9
    assert psnr_db(picture.rgb[picture.coverage] / 255, photo[picture.coverage] / 255) >= 45


def test_baseline__reads_photos_again_where_they_do_not_fit_the_budget(renderer):
    scene, photos = photographed(np.random.default_rng(3))
    view = camera_looking(np.add(ORIGIN, (0.1, -1.0, 0.2)), ORIGIN)
    kept = drawn(renderer, scene, photos, view)
    assert (drawn(renderer, scene, photos, view, photo_budget_bytes=0).rgb == kept.rgb).all()


def test_baseline__refuses_a_photo_of_another_size(renderer):
    scene, photos = photographed(np.random.default_rng(4))
    with pytest.raises(InvalidScan, match="photo 'a'"):
        drawn(renderer, scene, [photos[1], photos[0]], camera_looking(np.add(ORIGIN, (0, -1, 0)), ORIGIN))
