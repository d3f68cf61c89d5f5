"""The viewer in Chromium: its pictures against the product's own, its measuring, its keys, its requests."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from renderer.effects.relighting import AS_PHOTOGRAPHED, USUAL_LAMP, lamp
from renderer.splats.scene import GpuScene
from renderer.splats.views import orbit_views, up_direction
from storage.maps import IN_PART
from storage.packed.dictionaries.shipped import NEWEST, shipped
from storage.packed.schema import GROUP, MAX_ATOMS
from tests.mapped_scenes import STATION, moved, wall_map, with_maps
from tests.packed_files import write_arrays
from tests.programs_of_others import node_module
from tests.runs import on_runs
from tests.scenes import Dictionary, Settings, build_scene, camera_looking, coded, random_dictionary, sheet
from tests.services.chromium import MESA, SWIFTSHADER, Page, chromium_path
from tests.services.web.served import is_same_driver, open_viewer, picture_of, serving, small

pytestmark = pytest.mark.skipif(chromium_path() is None, reason="needs Chromium (apt-get install chromium)")
UTM = (450000.25, 5400000.5, 100.0)
SNAPPED_PX = 1 / 32  # how far SwiftShader, which draws here, moves a corner at most: it rounds to a sixteenth


def scene_of(name: str, smallest: float = 0.02):
    rng = np.random.default_rng(3)
    dictionary = random_dictionary(rng)
    if name == "atoms":
        return build_scene(sheet(rng, 400, **coded(rng, 400)), Settings(radius=0.1), dictionary)
    if name.startswith("runs"):
        return on_runs(
            scene_of({"runs": "groups", "runs-in-boxes": "everything"}[name], smallest=0.13)
        )  # cells of 0.06, no pinholes
    if name == "quadrics-in-boxes":
        axes = np.tile(np.diag([0.12, 0.06, 0.03])[[0, 2, 1]], (300, 1, 1))
        axes[rng.random(300) < 0.7] = np.nan
        return build_scene(sheet(rng, 300, axes=axes), Settings(radius=0.12, color_step=112, quadric_error=1 / 30))
    if name in ("groups", "quadrics"):
        n = GROUP + 300
        line = np.tile([0.8, 0.6, 0.1], (n, 1))
        line[rng.random(n) < 0.6] = np.nan
        splats = sheet(rng, n, clipline=line, **coded(rng, n, max_atoms=3))
        splats = replace(splats, position=splats.position + UTM)
        cameras = tuple(replace(camera_looking(np.add(UTM, (x, -2, 0.3)), UTM), name=f"{x}.jpg") for x in (-0.4, 0.1))
        splats = replace(splats, size=smallest * 2.5 ** rng.random(n))
        error = 1 / 30 if name == "quadrics" else None
        return build_scene(splats, Settings(0.03, UTM, cameras=cameras, quadric_error=error), dictionary)
    if name == "maps":
        axes = np.tile(np.diag([0.12, 0.06, 0.03])[[0, 2, 1]], (400, 1, 1))
        axes[rng.random(400) < 0.7] = np.nan
        splats = sheet(rng, 400, tilt=0.1, axes=axes)
        splats = replace(splats, position=splats.position + UTM)
        maps = [moved(wall_map(STATION + off, height), UTM) for off, height in ((0, 160), ([0.5, 0.2, 0.1], 112))]
        scene = build_scene(splats, Settings(radius=0.12, origin=UTM))
        station = rng.integers(-1, 2, 400)
        station[(station >= 0) & (rng.random(400) < 0.4)] += IN_PART
        return with_maps(scene, *maps, station=station)
    axes = np.tile(np.diag([0.12, 0.06, 0.03])[[0, 2, 1]], (500, 1, 1))
    axes[rng.random(500) < 0.7] = np.nan
    line = np.tile([0.8, 0.6, 0.1], (500, 1))
    line[(rng.random(500) < 0.6) | ~np.isnan(axes[:, 0, 0])] = np.nan
    texels, scale = shipped().texels[:20], shipped().scale[:20]  # bytes that none of the file hold
    turned = Dictionary(texels, scale, 4 * dictionary.weight_levels, n_turns=8)
    size = 0.07 * 2 ** rng.random(500)
    codes = coded(rng, 500, 160, max_atoms=16)
    codes["n_atoms"] = np.array([0, 1, 6, 16])[codes["n_atoms"] % 4]  # each number is a shader of its own
    splats = sheet(rng, 500, size=size, axes=axes, clipline=line, **codes)
    scene = build_scene(splats, Settings(radius=0.1, color_step=112), turned)
    effects = dict.fromkeys(("level_blending", "relighting", "normal_smoothing", "accumulation"), {})
    return replace(scene, header=replace(scene.header, effects=effects, shipped=NEWEST))


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    opened = Page(tmp_path_factory.mktemp("profile"), MESA)
    small(opened)
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def other_page(tmp_path_factory):
    """Drawn by another driver than the product's pictures."""
    opened = Page(tmp_path_factory.mktemp("profile"), SWIFTSHADER)
    small(opened)
    yield opened
    opened.close()


@pytest.fixture(autouse=True)
def _without_complaints_of_others(page):
    page.complaints.clear()


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """Addresses and scenes by name."""
    folder, running, found = tmp_path_factory.mktemp("files"), [], {}
    for name in ("atoms", "everything", "groups", "quadrics", "quadrics-in-boxes", "maps", "runs", "runs-in-boxes"):
        scene = scene_of(name)
        running.append(serving(write_arrays(scene.header, scene.arrays, folder / f"{name}.splatpress")))
        found[name] = running[-1].__enter__(), scene
    yield found
    for each in running:
        each.__exit__(None, None, None)


def psnr_db(squared: np.ndarray) -> float:
    return 10 * np.log10(255**2 / max(float(squared.mean()), 1e-9))


def assert_alike(page, renderer, scene, view, light=AS_PHOTOGRAPHED, max_atoms=MAX_ATOMS):
    """50 dB where both see something, coverage within 0.001, pixel by pixel. On another driver corners are rounded
    otherwise, which decides about pixels on rims: then each pixel is compared with the nearest of the product's picture
    and eight of it moved by what SwiftShader rounds, and the four pixels, or one of a thousand, that differ most are
    left out: a rim's corners are rounded one by one."""
    rgb, covered = picture_of(page, view)
    gpu_scene, s = GpuScene(scene, renderer.context), SNAPPED_PX
    same, views = is_same_driver(page, renderer), [view]
    if not same:
        views += [
            replace(view, cx_px=view.cx_px + x, cy_px=view.cy_px + y) for x in (-s, 0, s) for y in (-s, 0, s) if x or y
        ]
    pictures = [renderer.render(gpu_scene, each, max_atoms, light) for each in views]
    gpu_scene.release()
    both = covered & pictures[0].coverage
    assert both.mean() > 0.05
    error = [((picture.rgb.astype(float) - rgb) ** 2).mean(axis=-1)[both] for picture in pictures]
    nearest = np.sort(np.min(error, axis=0))
    assert psnr_db(nearest if same else nearest[: -max(4, len(nearest) // 1000)]) >= 50
    assert psnr_db(error[0]) >= 30  # and where corners lie is no excuse for all
    assert np.min([picture.coverage != covered for picture in pictures], axis=0).mean() <= 0.001


VIEWS = {  # eye, size, focal length
    "near": ((0.3, -1.2, 0.4), (200, 150), 180.0),
    "oblique": ((1.5, -0.5, 0.2), (160, 160), 150.0),
    "far": ((-0.5, -9.0, 2.0), (96, 128), 500.0),
}


@pytest.mark.parametrize(
    "name", ["atoms", "everything", "groups", "quadrics", "quadrics-in-boxes", "maps", "runs", "runs-in-boxes"]
)
def test_viewer__draws_what_render_does(page, served, renderer, name):
    url, scene = served[name]
    open_viewer(page, url)
    for eye, size, focal in VIEWS.values():
        origin = scene.header.origin
        view = camera_looking(np.add(origin, eye), origin, size, (focal, focal))
        assert_alike(page, renderer, scene, view)
    assert page.complaints == []
    found = json.loads(page.look("JSON.stringify(viewer.statistics())"))
    assert found["complete"] and found["received"] >= found["size"] * 0.5 and found["requests"] <= 12
    if name == "everything":
        flags = {"ELLIPSOID", "CLIPLINE", "LEVELS", "BLENDED", "TURNED", "COLOR_BOXES", "LIT", "SMOOTH"}
        assert {flag for flag in flags if f"{flag}=1" in " ".join(found["programs"])} == flags


@pytest.mark.parametrize("name", ["everything", "maps"])
def test_viewer__writes_depth_itself_where_clip_space_cannot_end_at_zero(page, served, renderer, name):
    url, scene = served[name]
    origin = scene.header.origin
    open_viewer(page, url + "?own-depth")
    assert not page.look("viewer.statistics().clipControl")
    for eye, size, focal in VIEWS.values():
        view = camera_looking(np.add(origin, eye), origin, size, (focal, focal))
        assert_alike(page, renderer, scene, view)
    assert page.complaints == []


def test_viewer__draws_the_same_on_another_driver(other_page, served, renderer):
    url, scene = served["groups"]
    open_viewer(other_page, url)
    for eye, size, focal in VIEWS.values():
        origin = scene.header.origin
        assert_alike(other_page, renderer, scene, camera_looking(np.add(origin, eye), origin, size, (focal, focal)))
    assert other_page.complaints == []


def test_viewer__lights_from_the_side_that_is_chosen(page, served, renderer):
    """As the usual lamp of the product, and that turned by a quarter about the line of sight."""
    url, scene = served["everything"]
    open_viewer(page, url)
    page.look("document.getElementById('light').click()")
    left, up, near = USUAL_LAMP
    towards = np.array(json.loads(page.look("JSON.stringify(viewer.lamp.towards)")))
    np.testing.assert_allclose(towards, np.array([left, -up, -near]) / np.linalg.norm(USUAL_LAMP))
    page.look("const side = document.getElementById('side'); side.value = 90; side.oninput()")
    eye, size, focal = VIEWS["near"]
    view = camera_looking(eye, (0, 0, 0), size, (focal, focal))
    assert_alike(page, renderer, scene, view, lamp(up, -left, near))


def test_viewer__cuts_away_what_lies_outside_a_section(page, served):
    """Half of the sheet by a slider, as seen in the picture and by what can be picked; all of it again at the slider's
    end."""
    url, scene = served["atoms"]
    open_viewer(page, url)
    view = camera_looking((0.0, -3.0, 0.2), (0, 0, 0), (160, 160), (150.0, 150.0))
    _, whole = picture_of(page, view)
    page.look("const x = viewer.section.inputs[1]; x.value = 500; x.oninput()")
    low, high = (np.array(json.loads(page.look(f"JSON.stringify(viewer.section.{side})"))) for side in ("low", "high"))
    box = json.loads(page.look("JSON.stringify(viewer.section.box)"))
    assert box["high"][0] == pytest.approx((low[0] + high[0]) / 2) and box["low"][0] < -1e9 and box["high"][1] > 1e9
    _, cut = picture_of(page, view)
    column = 80 + 150 * box["high"][0] / 3
    spare = 150 * 1.5 * scene.header.radius / 2.5  # a splat's radius, as near as the sheet comes
    columns = np.arange(160)
    left, right = columns < column - spare, columns > column + spare
    assert np.array_equal(cut[:, left], whole[:, left]) and whole[:, right].any() and not cut[:, right].any()
    page.look("const y = viewer.section.inputs[1]; y.value = 1000; y.oninput()")
    assert np.array_equal(picture_of(page, view)[1], whole) and page.complaints == []


@pytest.mark.parametrize("atoms", [0, 2])
def test_viewer__draws_as_few_atoms_as_are_asked_for(page, served, renderer, atoms):
    url, scene = served["atoms"]
    open_viewer(page, url)
    assert page.look("document.getElementById('atoms').max") == "8"
    page.look(f"const slider = document.getElementById('atoms'); slider.value = {atoms}; slider.oninput()")
    eye, size, focal = VIEWS["near"]
    assert_alike(page, renderer, scene, camera_looking(eye, (0, 0, 0), size, (focal, focal)), max_atoms=atoms)


def test_viewer__begins_at_most_half_as_far_again_where_boxes_are_those_of_frames(page, served):
    url, scene = served["quadrics"]
    open_viewer(page, url)
    (expected,) = orbit_views(scene, 1, (400, 400))
    found = json.loads(page.look("JSON.stringify(viewer.camera.view(400, 400))"))
    away = [np.linalg.norm(eye) for eye in (found["eye"], np.subtract(expected.centre, UTM))]
    assert 0.99 * away[1] <= away[0] <= 1.5 * away[1]
    np.testing.assert_allclose(found["rotation"], expected.rotation, atol=0.02)


def test_viewer__begins_where_render_orbits(page, served):
    url, scene = served["groups"]
    open_viewer(page, url)
    (expected,) = orbit_views(scene, 1, (400, 400))  # the page may be any shape: it begins with what a square one shows
    found = json.loads(page.look("JSON.stringify({ up: viewer.camera.up, ...viewer.camera.view(400, 400) })"))
    np.testing.assert_allclose(np.add(found["eye"], UTM), expected.centre, atol=1e-3)
    np.testing.assert_allclose(found["rotation"], expected.rotation, atol=1e-4)
    np.testing.assert_allclose(found["up"], up_direction(scene.header), atol=1e-9)
    assert found["fx"] == pytest.approx(expected.fx_px)


def on_sheet(scene, view: dict, x: float, y: float) -> np.ndarray:
    """Where the ray of a pixel meets the sheet of `scene_of`, y = 0 against the origin."""
    ray = np.array([(x - view["cx"]) / view["fx"], (y - view["cy"]) / view["fy"], 1]) @ np.array(view["rotation"])
    eye = np.array(view["eye"])
    return eye - ray * eye[1] / ray[1]


def test_viewer__measures_a_scan_of_large_coordinates_to_a_radius(page, served):
    url, scene = served["groups"]
    open_viewer(page, url)
    page.look("viewer.stand(0)")
    width, height = page.look("viewer.canvas.clientWidth"), page.look("viewer.canvas.clientHeight")
    view = json.loads(page.look("(viewer.frame(1), JSON.stringify(viewer.shownView()))"))
    scale = view["width"] / width
    places = [(width * x, height * y) for x, y in ((0.45, 0.5), (0.56, 0.44), (0.5, 0.55))]
    picked = [np.array(json.loads(page.look(f"JSON.stringify(viewer.pick({x}, {y}))"))) for x, y in places]
    for (x, y), point in zip(places, picked, strict=True):
        assert np.linalg.norm(point - on_sheet(scene, view, x * scale, y * scale)) <= scene.header.radius
    assert page.look("viewer.pick(1, 1)") is None  # the sky
    page.look("document.getElementById('measure').click()")
    for x, y in places[:2]:
        page.look(f"viewer.tapped({x}, {y}, false)")
    said = page.look("document.getElementById('measured').textContent")
    shown = [[float(n) for n in re.findall(r"-?\d+\.?\d*", line)] for line in said.splitlines()]
    np.testing.assert_allclose(shown[0], picked[0] + UTM, atol=2e-3)
    expected = np.linalg.norm(picked[1] - picked[0])
    assert shown[2][0] == pytest.approx(expected, rel=1e-4) and " m," in said
    page.until("document.querySelectorAll('#overlay circle').length === 2")
    page.look(f"viewer.tapped({places[2][0]}, {places[2][1]}, false)")
    said = page.look("document.getElementById('measured').textContent")
    first, second, third = picked
    sides = first - second, third - second
    angle = np.degrees(np.arccos(sides[0] @ sides[1] / np.prod(np.linalg.norm(sides, axis=1))))
    assert float(re.search(r"angle at B: ([\d.]+)", said)[1]) == pytest.approx(angle, rel=1e-3)
    area = np.linalg.norm(np.cross(*sides)) / 2
    assert float(re.search(r"area ([\d.e-]+) square m", said)[1]) == pytest.approx(area, rel=1e-3)
    page.look("document.getElementById('canvas').focus()")
    press(page, "Backspace", "Backspace")
    assert "C:" not in page.look("document.getElementById('measured').textContent")


def test_viewer__measures_by_keyboard_alone(page, served):
    open_viewer(page, served["groups"][0])
    page.look("document.getElementById('canvas').focus()")
    for key, code in (("1", "Digit1"), ("m", "KeyM"), ("Enter", "Enter")):
        press(page, key, code)
    press(page, "ArrowRight", "ArrowRight")
    press(page, "Enter", "Enter")
    said = page.look("document.getElementById('measured').textContent")
    assert said.startswith("A: ") and "A to B: " in said
    assert float(re.search(r"A to B: ([\d.e-]+)", said)[1]) > 0
    press(page, "Escape", "Escape")
    assert page.look("document.getElementById('measured').hidden")


def press(page, key: str, code: str) -> None:
    page.call("Input.dispatchKeyEvent", type="keyDown", key=key, code=code)
    page.call("Input.dispatchKeyEvent", type="keyUp", key=key, code=code)


def test_viewer__turns_by_mouse_and_touch_and_keeps_the_camera_in_the_address(page, served):
    open_viewer(page, served["groups"][0])
    before = np.array(json.loads(page.look("JSON.stringify(viewer.camera.eye)")))
    for kind, x in (("mousePressed", 200), ("mouseMoved", 280), ("mouseReleased", 280)):
        page.call("Input.dispatchMouseEvent", type=kind, x=x, y=150, button="left", buttons=1, clickCount=1)
    turned = np.array(json.loads(page.look("JSON.stringify(viewer.camera.eye)")))
    assert np.linalg.norm(turned - before) > 0.1 and np.linalg.norm(turned) == pytest.approx(
        np.linalg.norm(before), rel=0.1
    )
    points = [{"x": 150, "y": 150, "id": 0}, {"x": 250, "y": 150, "id": 1}]
    page.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=points)
    page.call("Input.dispatchTouchEvent", type="touchMove", touchPoints=[points[0], {"x": 350, "y": 150, "id": 1}])
    page.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    distance = page.look("viewer.camera.distance")
    assert distance < 0.7 * np.linalg.norm(before)
    address = page.until("location.hash === '#c=' + viewer.camera.toText() && location.href")
    eye = json.loads(page.look("JSON.stringify(viewer.camera.eye)"))
    page.open("about:blank")
    open_viewer(page, address)
    np.testing.assert_allclose(json.loads(page.look("JSON.stringify(viewer.camera.eye)")), eye, atol=2e-3)
    assert page.look("viewer.camera.distance") == pytest.approx(distance, rel=1e-3)


def test_viewer__stands_where_photographs_were_taken(page, served, renderer):
    url, scene = served["groups"]
    open_viewer(page, url)
    assert (
        page.look("[...document.querySelectorAll('#photos option')].map((o) => o.text).join()")
        == "photographs,-0.4.jpg,0.1.jpg"
    )
    page.look("(viewer.stand(1), null)")
    assert page.look("document.getElementById('photos').value") == "1"
    camera = scene.header.cameras[1]
    found = json.loads(page.look(f"JSON.stringify(viewer.camera.view({camera.width_px}, {camera.height_px}))"))
    np.testing.assert_allclose(found["rotation"], camera.rotation, atol=1e-9)
    np.testing.assert_allclose(
        [found[name] for name in ("fx", "fy", "cx", "cy")], [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]
    )


@pytest.mark.parametrize(("width", "scheme"), [(360, "light"), (1280, "dark")])
def test_viewer__fits_phones_and_dark_rooms(page, served, width, scheme, tmp_path):
    page.call("Emulation.setDeviceMetricsOverride", width=width, height=640, deviceScaleFactor=1, mobile=width < 500)
    page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
    try:
        open_viewer(page, served["atoms"][0])
        inside = "[...document.querySelectorAll('#bar > *')].every((e) => { const r = e.getBoundingClientRect(); return r.left >= 0 && r.right <= innerWidth; })"
        assert page.look(inside) and page.look("document.documentElement.scrollWidth") <= width
        ground = page.look("getComputedStyle(document.body).backgroundColor")
        assert (sum(map(int, re.findall(r"\d+", ground))) < 200) == (scheme == "dark")
    finally:
        small(page)
        page.call("Emulation.setEmulatedMedia", features=[])


@pytest.mark.parametrize("state", ["plain", "measuring", "problem"])
def test_viewer__is_for_everyone(page, served, state):
    """axe finds nothing serious."""
    axe = (node_module("axe-core") / "axe.min.js").read_text()
    open_viewer(page, served["groups"][0])
    if state == "measuring":
        page.look("document.getElementById('measure').click()")
    if state == "problem":
        page.look(
            "document.getElementById('problem').hidden = false; document.getElementById('problem').textContent = 'a problem'"
        )
    page.call("Runtime.evaluate", expression=axe)
    found = json.loads(
        page.look(
            "axe.run().then((r) => JSON.stringify(r.violations.map((v) => [v.id, v.impact, v.nodes.map((n) => n.html)])))"
        )
    )
    assert [each for each in found if each[1] in ("serious", "critical")] == []
