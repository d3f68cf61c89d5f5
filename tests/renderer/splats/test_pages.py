"""Pages on the GPU: with all of them there the picture is that of whole photographs; with none beyond the tails it is
the atoms' or a blurred one; what is asked for is listed exactly."""

import threading
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.effects.exposure.photographs import read_photo
from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import settings_for
from pipeline.stages.pages.codecs import decoded
from pipeline.stages.pages.coded import PageForm
from renderer.evaluate import flight as flight_module
from renderer.evaluate import paged_photos
from renderer.evaluate.compare import psnr_db
from renderer.evaluate.flight import Flight
from renderer.evaluate.paged_photos import PagedPhotos
from renderer.residency.paths import pose_of
from renderer.residency.places import Places, Screen
from renderer.residency.prediction import Motion
from renderer.residency.scene import scene_places
from renderer.splats.baseline import PhotoSplats
from renderer.splats.pages import GpuPages, pool_shape
from renderer.splats.scene import GpuScene
from renderer.splats.views import view_of
from services.processes.compress import compress
from services.processes.pages.page_file import make_pages
from storage.errors import InvalidPackedFile, ResourceExhausted
from storage.packed.packed import PackedFile, PackedScene
from storage.pages.file import PageFile
from tests.effects_scans import wall_scan
from tests.pipeline.execution.test_stage import Heard

STILL = Motion(np.zeros(3), np.zeros(3))


@dataclass(frozen=True)
class Made:
    scene: PackedScene  # of cameras that agree with their neighbours
    with_atoms: PackedScene  # the same, whose splats stand in another order
    places: Places
    places_with_atoms: Places
    pages: Path
    photos: Path


def opened_scene(path: Path) -> PackedScene:
    with PackedFile(path) as opened:
        return opened.load()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A wall of few, wide splats in plain colours, and its photographs in pages of 32 px."""
    folder = tmp_path_factory.mktemp("pages")
    scan = wall_scan(folder / "wall", 24)
    rng = np.random.default_rng(4)
    for photo in sorted((scan / "images").iterdir()):  # grain, which neither atoms nor coarse levels keep
        pixels = np.asarray(Image.open(photo).convert("RGB")).astype(int)
        grain = np.kron(
            rng.integers(-14, 15, (-(-pixels.shape[0] // 3), -(-pixels.shape[1] // 3), 3)), np.ones((3, 3, 1), int)
        )
        Image.fromarray(np.clip(pixels + grain[: pixels.shape[0], : pixels.shape[1]], 0, 255).astype(np.uint8)).save(
            photo
        )
    settings = settings_for("draft", texture="color")
    compress(scan, folder / "out", settings, SerialExecutor(), Heard(), render=False, work=folder / "work")
    form = PageForm("png", 32)
    make_pages(folder / "work", folder / "wall.pages", form, SerialExecutor(), Heard())
    few = settings_for("draft", dictionary="own", training_splats=256, iterations=1, max_atoms=1)
    compress(scan, folder / "atoms", few, SerialExecutor(), Heard(), render=False, work=folder / "work")
    scene, with_atoms = (opened_scene(folder / name / "wall.splatpress") for name in ("out", "atoms"))
    (places, label), (places_with_atoms, of_atoms) = (scene_places(s, 1, 32) for s in (scene, with_atoms))
    scene = replace(scene, arrays=scene.arrays | {"camera": label})
    with_atoms = replace(with_atoms, arrays=with_atoms.arrays | {"camera": of_atoms})
    return Made(
        scene, with_atoms, places, places_with_atoms, folder / "wall.pages", next((folder / "work").glob("ingest-*"))
    )


@pytest.fixture
def shown(made, renderer):
    """The scene with its pages on the GPU, tails alone in the pool."""
    gpu_scene = GpuScene(made.scene, renderer.context)
    with PageFile(made.pages) as file:
        gpu_scene.pages = GpuPages(
            renderer.context, file.layout, file.header.border_px, made.scene.header.cameras, made.scene.arrays["camera"], 4 << 20
        )  # fmt: skip
        for page in np.flatnonzero(file.layout.is_tail):
            put(gpu_scene.pages, file, int(page))
        yield gpu_scene, file
    gpu_scene.pages.release()
    gpu_scene.release()


def put(pages: GpuPages, file: PageFile, page: int) -> None:
    pages.put(page, decoded(file.header.codec, file.read(page), file.header.side_px, "a page"))


def looked(renderer, gpu_scene, view):
    gpu_scene.pages.show_all(view.width_px, view.height_px)
    return renderer.render(gpu_scene, view)


def baseline_of(made, renderer, view):
    gpu_scene = GpuScene(made.scene, renderer.context)
    photos = PhotoSplats(gpu_scene, lambda i: read_photo(made.photos, i))
    picture = renderer.render_baseline(photos, view)
    photos.release()
    gpu_scene.release()
    return picture


@pytest.mark.parametrize("size", [(320, 240), (640, 480), (110, 83)])
def test_pages__with_all_of_them_the_picture_is_that_of_whole_photographs(made, shown, renderer, size):
    gpu_scene, file = shown
    view = view_of(made.scene.header.cameras[1], size)
    for page in np.flatnonzero(~file.layout.is_tail):
        put(gpu_scene.pages, file, int(page))
    picture, wanted = looked(renderer, gpu_scene, view), baseline_of(made, renderer, view)
    assert np.array_equal(picture.coverage, wanted.coverage)
    assert psnr_db(picture.rgb, wanted.rgb, wanted.coverage) > 50


def test_pages__with_tails_alone_the_picture_is_blurred_and_no_garbage(made, shown, renderer):
    gpu_scene, _ = shown
    view = view_of(made.scene.header.cameras[1])
    picture, wanted = looked(renderer, gpu_scene, view), baseline_of(made, renderer, view)
    assert 18 < psnr_db(picture.rgb, wanted.rgb, wanted.coverage) < 50


def test_pages__what_was_asked_for_is_listed_as_the_buffer_has_it_and_emptied(made, shown, renderer):
    gpu_scene, file = shown
    view = view_of(made.scene.header.cameras[0])
    renderer.render(gpu_scene, view)
    gpu_scene.pages.show_all(view.width_px, view.height_px, (120, 0, 0, 80))
    renderer.flatten_feedback(gpu_scene)
    renderer.render(gpu_scene, view)
    found = gpu_scene.pages.feedback()
    renderer.flatten_feedback(gpu_scene)
    rows, lost = gpu_scene.pages.listed()
    pages = np.flatnonzero(found.any(axis=1))
    assert lost == 0 and len(pages) > 10 and found[:, 1].any()
    assert np.array_equal(rows, np.column_stack([pages, found[pages]]))
    assert not gpu_scene.pages.feedback().any()


@pytest.mark.parametrize("prediction", ["nothing", "combined"])
def test_flight__once_it_has_settled_the_picture_is_that_of_whole_photographs(made, shown, renderer, prediction):
    gpu_scene, file = shown
    for page in np.flatnonzero(file.layout.is_tail):
        gpu_scene.pages.drop(int(page))
    camera = made.scene.header.cameras[1]
    screen = Screen(camera.width_px, camera.height_px, camera.fx_px)
    flight = Flight(renderer, gpu_scene, made.places, file, screen, 4.0, prediction, n_frame=8)
    wanted = baseline_of(made, renderer, camera)
    first, record = flight.frame(pose_of(camera), STILL)
    assert record.missed > 0 and psnr_db(first.rgb, wanted.rgb, wanted.coverage) < 50
    assert 3 < flight.settle(pose_of(camera)) < 200
    picture, record = flight.frame(pose_of(camera), STILL)
    flight.close()
    assert record.missed == 0 and record.late == 0
    assert picture.rgb.shape == wanted.rgb.shape and psnr_db(picture.rgb, wanted.rgb, wanted.coverage) > 50


def test_flight__in_a_pool_too_small_for_the_view_it_stands_still_no_longer_than_in_simulation(made, renderer):
    gpu_scene, camera = GpuScene(made.scene, renderer.context), made.scene.header.cameras[1]
    with PageFile(made.pages) as file:
        n_bytes = 25 * 3 * file.header.side_px**2
        label = made.scene.arrays["camera"]
        gpu_scene.pages = GpuPages(renderer.context, file.layout, 4, made.scene.header.cameras, label, n_bytes)
        flight = Flight(renderer, gpu_scene, made.places, file, Screen(320, 240, 240.0), 4.0, "nothing", n_frame=8)
        assert flight.settle(pose_of(camera)) == flight.most_settling < 100
        picture, record = flight.frame(pose_of(camera), STILL)
        flight.close()
    assert record.missed > 0 and picture.coverage.any()
    gpu_scene.pages.release()
    gpu_scene.release()


def test_flight__a_page_that_was_altered_is_one_error(made, shown, renderer, tmp_path):
    data = bytearray(made.pages.read_bytes())
    data[-200] ^= 1
    (tmp_path / "altered.pages").write_bytes(data)
    gpu_scene, _ = shown
    camera = made.scene.header.cameras[0]
    with PageFile(tmp_path / "altered.pages") as file:
        for page in np.flatnonzero(file.layout.is_tail):
            gpu_scene.pages.drop(int(page))
        with pytest.raises(InvalidPackedFile, match="differs from its check"):
            Flight(renderer, gpu_scene, made.places, file, Screen(320, 240, camera.fx_px), 4.0)


def test_flight__on_a_disk_that_stalls_it_goes_on_with_coarser_pages_and_says_so(made, shown, renderer, monkeypatch):
    gpu_scene, file = shown
    for page in np.flatnonzero(file.layout.is_tail):
        gpu_scene.pages.drop(int(page))
    monkeypatch.setattr(flight_module, "STALL_S", 0.001)
    monkeypatch.setattr(flight_module, "TAIL_S", 0.05)
    monkeypatch.setattr(flight_module, "STALLED_FRAMES", 3)
    camera = made.scene.header.cameras[1]
    answers, read = threading.Event(), PageFile.read
    tails = set(np.flatnonzero(file.layout.is_tail).tolist())

    def stalling(self, page):
        if page not in tails:
            answers.wait(20)
        return read(self, page)

    monkeypatch.setattr(PageFile, "read", stalling)
    flight = Flight(renderer, gpu_scene, made.places, file, Screen(320, 240, camera.fx_px), 4.0, "nothing", n_frame=8)
    assert flight.settle(pose_of(camera)) < 40
    picture, record = flight.frame(pose_of(camera), STILL)
    assert record.late > 0 and record.missed > 0
    wanted = baseline_of(made, renderer, camera)
    assert psnr_db(picture.rgb, wanted.rgb, wanted.coverage) > 18
    answers.set()
    flight.close()
    for page in tails:
        gpu_scene.pages.drop(page)
    tails.clear()
    answers.clear()
    with pytest.raises(ResourceExhausted, match="not read within"):
        Flight(renderer, gpu_scene, made.places, file, Screen(320, 240, camera.fx_px), 4.0)
    answers.set()


def test_pool__takes_what_fits_and_says_where_too_little_does():
    shape = pool_shape(256 << 20, 136, 100, 4096, 2048)
    assert shape.n_bytes <= 256 << 20 and shape.n_pages > 4000
    with pytest.raises(ResourceExhausted, match="--pool-mib"):
        pool_shape(1 << 20, 136, 100, 4096, 2048)


@pytest.mark.parametrize("n_pages", [25, 100])
def test_paged_photos__however_small_the_pool_the_picture_is_the_baseline_s(made, renderer, n_pages):
    views = [view_of(made.scene.header.cameras[i], (320, 240)) for i in (0, 1)]
    gpu_scene = GpuScene(made.scene, renderer.context)
    with PageFile(made.pages) as file:
        photos = PagedPhotos(gpu_scene, file, n_pages * 3 * file.header.side_px**2)
        for view in [*views, views[0]]:
            picture, wanted = photos.draw(renderer, view), baseline_of(made, renderer, view)
            assert np.array_equal(picture.coverage, wanted.coverage)
            assert psnr_db(picture.rgb, wanted.rgb, wanted.coverage) > 50
            assert photos.n_parts > 1 if n_pages == 25 else photos.n_parts <= 2
        photos.release()
    assert gpu_scene.pages is None
    gpu_scene.release()


def test_paged_photos__an_altered_page_and_a_disk_that_stalls_are_one_error(made, renderer, tmp_path, monkeypatch):
    data = bytearray(made.pages.read_bytes())
    data[-200] ^= 1  # of the last photograph's tail
    (tmp_path / "altered.pages").write_bytes(data)
    gpu_scene = GpuScene(made.scene, renderer.context)
    with PageFile(tmp_path / "altered.pages") as file, pytest.raises(InvalidPackedFile, match="differs from its check"):
        PagedPhotos(gpu_scene, file, 4 << 20)
    monkeypatch.setattr(paged_photos, "READ_S", 0.05)
    answers, read = threading.Event(), PageFile.read
    monkeypatch.setattr(PageFile, "read", lambda self, page: (answers.wait(20), read(self, page))[1])
    with PageFile(made.pages) as file, pytest.raises(ResourceExhausted, match="not read within"):
        PagedPhotos(gpu_scene, file, 4 << 20)
    answers.set()
    gpu_scene.release()


def test_flight__while_pages_arrive_the_picture_is_never_below_that_of_atoms(made, renderer):
    """Four pages a frame; every picture against the photographs."""
    scene, camera = made.with_atoms, made.scene.header.cameras[1]
    gpu_scene = GpuScene(scene, renderer.context)
    wanted = baseline_of(made, renderer, camera)

    def off(picture) -> float:
        return psnr_db(picture.rgb, wanted.rgb, wanted.coverage)

    of_atoms, shown = off(renderer.render(gpu_scene, camera)), []
    with PageFile(made.pages) as file:
        label = scene.arrays["camera"]
        gpu_scene.pages = GpuPages(renderer.context, file.layout, 4, scene.header.cameras, label, 4 << 20)
        screen = Screen(camera.width_px, camera.height_px, camera.fx_px)
        flight = Flight(renderer, gpu_scene, made.places_with_atoms, file, screen, 4.0, "nothing", n_frame=4)
        for _ in range(80):
            picture, record = flight.frame(pose_of(camera), STILL)
            shown.append(off(picture))
            if len(shown) > 10 and record.missed == 0:
                break
        flight.close()
    gpu_scene.pages.release()
    gpu_scene.release()
    assert of_atoms < 32 and shown[-1] > 40 and len(shown) > 12
    assert min(shown) > of_atoms - 0.05
