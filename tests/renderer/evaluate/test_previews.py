"""Previews: which pictures are made, what they are called, and the figures of each view."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.readers.photos import decode_photo
from renderer.evaluate.previews import (
    FIGURES,
    MAX_NAME,
    WARM_UP_PX,
    PreviewOptions,
    even_choice,
    make_previews,
    safe_names,
)
from renderer.splats.scene import GpuScene
from renderer.splats.targets import NARROW, WIDE
from renderer.splats.views import station_views, view_of
from tests.scenes import Settings, Splats, build_scene, camera_looking, random_dictionary

SIZE = (120, 90)
NAMES = ("left/0001.jpg", "left_0001.png", "../<b>&\"'.jpg")


def photo_of(index, size=SIZE):
    y, x = np.mgrid[: size[1], : size[0]]
    waves = [np.sin(x / 9 + index), np.cos(y / 8), np.sin((x + y) / 12)]
    return np.round(128 + 90 * np.stack(waves, axis=-1)).astype(np.uint8)


def wall(names=NAMES, camera=None, n=600, textured=False):
    """A wall of splats before some cameras that stand side by side; every splat has the given camera, or any."""
    rng = np.random.default_rng(4)
    position = np.stack([rng.uniform(-1, 1, n), np.zeros(n), rng.uniform(-1, 1, n)], axis=1)
    cameras = tuple(
        camera_looking((0.4 * i, -2.5, 0.2), (0, 0, 0), SIZE, (110, 110), name=name) for i, name in enumerate(names)
    )
    splats = Splats(
        position,
        np.tile([0.0, -1, 0], (n, 1)),
        rng.integers(60, 200, (n, 3)).astype(np.uint8),
        n_atoms=rng.integers(0, 9, n) if textured else None,
        atom=rng.integers(0, 20, (n, 8)),
        weight=rng.integers(0, 16, (n, 8)),
        camera=(rng.integers(0, len(names), n) if camera is None else np.full(n, camera)) if names else None,
    )
    return build_scene(splats, Settings(radius=0.15, cameras=cameras), random_dictionary(rng) if textured else None)


def test_previews__of_photographed_scans_show_packed_baseline_and_photo(renderer, tmp_path):
    rows = make_previews(wall(), tmp_path, photo_of, renderer)
    assert [row.camera for row in rows] == list(NAMES)
    for row in rows:
        assert set(row.pictures) == {"packed", "baseline", "photo"}
        for path in row.pictures.values():
            assert decode_photo(str(tmp_path / path), path).shape == (row.height_px, row.width_px, 3)
        assert all(np.isfinite(getattr(row, key)) for key in FIGURES)
        assert list(row.seconds) == list(row.baseline_seconds) == ["cull", "visibility", "attribute", "resolve"]
        assert 0.1 < row.coverage < 0.9
    assert len({path for row in rows for path in row.pictures.values()}) == 9
    assert not list(tmp_path.rglob("*.partial"))


def test_previews__sums_are_as_wide_as_the_views_call_for(renderer, tmp_path):
    """Splats that overdraw the small picture by which shaders are compiled, and no view."""
    rng, n = np.random.default_rng(4), 20_000
    position = np.stack([rng.uniform(-1, 1, n), np.zeros(n), rng.uniform(-1, 1, n)], axis=1)
    camera = camera_looking((0, -2.5, 0.2), (0, 0, 0), (480, 360), (440, 440))
    scene = build_scene(Splats(position, np.tile([0.0, -1, 0], (n, 1))), Settings(radius=0.01, cameras=(camera,)))
    gpu_scene = GpuScene(scene, renderer.context)
    small = renderer.render(gpu_scene, view_of(camera, WARM_UP_PX)).accumulation
    gpu_scene.release()
    assert (small, make_previews(scene, tmp_path, renderer=renderer)[0].accumulation) == (WIDE, NARROW)


def test_previews__write_the_pictures_that_they_measure(renderer, tmp_path):
    row = make_previews(wall(), tmp_path, photo_of, renderer)[1]
    paths = [tmp_path / row.pictures[kind] for kind in ("packed", "baseline")]
    packed, baseline = (decode_photo(str(path), path.name).astype(float) for path in paths)
    covered = packed.any(axis=-1) & baseline.any(axis=-1)  # no splat of the wall is black
    error = ((packed - baseline)[covered] ** 2).mean()
    assert row.psnr_vs_baseline_db == pytest.approx(10 * np.log10(255**2 / error), abs=1e-6)
    assert row.coverage == pytest.approx(covered.mean())


def test_previews__baseline_is_the_photo_where_its_own_camera_looks(renderer, tmp_path):
    row = make_previews(wall(camera=1), tmp_path, photo_of, renderer)[1]
    assert row.baseline_psnr_vs_photo_db > 40  # and not at all from where another camera's photo is seen
    assert row.psnr_vs_photo_db < 20


def test_previews__without_photographs_show_the_packed_scene_alone(renderer, tmp_path):
    rows = make_previews(wall(), tmp_path, None, renderer)
    assert len(rows) == 3
    for row in rows:
        assert set(row.pictures) == {"packed"} and row.baseline_seconds is None
        assert all(getattr(row, key) is None for key in FIGURES)


def test_previews__without_cameras_orbit_the_scan(renderer, tmp_path):
    options = PreviewOptions(n_orbits=3, orbit_size_px=(64, 48))
    rows = make_previews(wall(names=(), textured=True), tmp_path, photo_of, renderer, options)
    assert [(row.width_px, row.height_px) for row in rows] == [(64, 48)] * 3
    assert all(getattr(row, key) is None for row in rows for key in FIGURES)
    assert any(row.coverage > 0.1 for row in rows)
    assert len(list((tmp_path / "previews").iterdir())) == 3


def test_previews__without_cameras_look_from_stations_at_most_of_the_scan(renderer, tmp_path):
    options = PreviewOptions(n_cameras=2, n_orbits=1, orbit_size_px=(64, 48))
    scene = wall(names=())
    stations = [(x, -1.5, 0.0) for x in (-1.0, 0.0, 1.0)]
    rows = make_previews(scene, tmp_path, None, renderer, options, stations=stations)
    assert [row.camera for row in rows] == ["station_001", "station_002", "orbit_000"]
    for row, view in zip(rows, station_views(scene, stations[::2], (64, 48)), strict=False):
        assert view.centre in stations and row.coverage > 0.1


def test_previews__take_at_most_so_many_cameras_evenly(renderer, tmp_path):
    scene = wall(names=tuple(f"{i}.jpg" for i in range(7)))
    rows = make_previews(scene, tmp_path, photo_of, renderer, PreviewOptions(n_cameras=3))
    assert [row.camera for row in rows] == ["0.jpg", "3.jpg", "6.jpg"]


def test_previews__compare_large_photographs_at_a_smaller_size(renderer, tmp_path):
    row = make_previews(wall(camera=0), tmp_path, photo_of, renderer, PreviewOptions(max_side_px=60))[0]
    assert (row.width_px, row.height_px) == (60, 45)
    assert row.baseline_psnr_vs_photo_db > 30


def test_previews__of_a_camera_that_sees_no_splat_have_no_figures(renderer, tmp_path):
    scene = wall(names=("a.jpg",))
    away = replace(scene.header.cameras[0], centre=(0.0, 2.5, 0.0))
    scene = replace(scene, header=replace(scene.header, cameras=(away,)))
    row = make_previews(scene, tmp_path, photo_of, renderer)[0]
    assert row.coverage == 0 and all(getattr(row, key) is None for key in FIGURES)


def test_previews__tell_their_progress(renderer, tmp_path):
    told = []
    make_previews(wall(), tmp_path, None, renderer, progress=lambda done, total: told.append((done, total)))
    assert told == [(1, 3), (2, 3), (3, 3)]


ALIKE = ["a.jpg", "A.jpg", "a-2.jpg", "a", "a/b.png", "a_b.jpg", "..", "/"]


@given(st.lists(st.text() | st.sampled_from(ALIKE), max_size=12))
def test_safe_names__are_plain_and_differ_even_without_case(names):
    safe = safe_names(names)
    assert len({name.lower() for name in safe}) == len(safe) == len(names)
    for name in safe:
        assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name) and len(name) <= MAX_NAME + 4


@given(st.integers(0, 300), st.integers(1, 40))
def test_even_choice__has_both_ends_and_no_repeats(n, n_chosen):
    chosen = even_choice(n, n_chosen)
    assert len(set(chosen)) == len(chosen) == min(n, n_chosen)
    assert chosen == sorted(chosen)
    if len(chosen) > 1:
        gaps = np.diff(chosen)
        assert (chosen[0], chosen[-1]) == (0, n - 1) and gaps.max() - gaps.min() <= 1
