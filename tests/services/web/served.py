"""The viewer of a packed file on loopback, in a thread, and pictures out of the page."""

from __future__ import annotations

import json
import threading
import time
from base64 import b64decode
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import numpy as np
import uvicorn

from renderer.splats.renderer import Renderer
from services.web.viewing import viewer_app
from storage.packed.schema import Camera
from tests.services.chromium import Page
from tests.services.service_process import free_port

READY = "!document.getElementById('problem').hidden || !!(window.viewer && viewer.complete && viewer.splats !== undefined && !viewer.queued)"
_TEXT = "(() => { const b = BYTES; let s = ''; for (let i = 0; i < b.length; i += 8192) s += String.fromCharCode(...b.subarray(i, i + 8192)); return btoa(s); })()"


@contextmanager
def serving(packed: Path, wrapped=lambda app: app) -> Iterator[str]:
    """The address of the viewer of a file; `wrapped` may put something between browser and app."""
    port = free_port()
    server = uvicorn.Server(
        uvicorn.Config(wrapped(viewer_app(packed)), port=port, log_level="critical", timeout_graceful_shutdown=1)
    )
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.02)
    try:
        yield f"http://127.0.0.1:{port}/"
    finally:
        server.should_exit = True
        thread.join(10)


def small(page: Page, width: int = 480, height: int = 360) -> None:
    """A window in which a frame without a graphics card takes a tenth of a second."""
    page.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)


def open_viewer(page: Page, url: str) -> None:
    """Wait until all of the file is drawn; the page says no problem."""
    page.open(url)
    page.until(READY)
    said = page.look("document.getElementById('problem').textContent")
    assert said == "", said


def picture_of(page: Page, view: Camera, most_splats: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(h, w, 3) uint8 and coverage (h, w) of what the viewer draws."""
    return _pixels(page, f"viewer.picture({json.dumps(asdict(view))}, {most_splats or 'Infinity'})", view)


def is_same_driver(page: Page, renderer: Renderer) -> bool:
    """Whether the page is drawn by what draws the product's pictures, so that both round alike."""
    drawn_by = page.look(
        "(() => { const { gl } = viewer.renderer; return gl.getParameter(gl.getExtension('WEBGL_debug_renderer_info').UNMASKED_RENDERER_WEBGL); })()"
    )
    return renderer.context.info["GL_RENDERER"] in drawn_by


def settled_picture(page: Page, view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The same of the picture that comes to rest at a view of the window's size."""
    page.look(f"(viewer.complete = false, viewer.camera.stand({json.dumps(asdict(view))}), viewer.moved(), null)")
    page.until("viewer.statistics().settled && !viewer.queued")
    return _pixels(page, "viewer.renderer.pixels()", view)


def _pixels(page: Page, script: str, view: Camera) -> tuple[np.ndarray, np.ndarray]:
    text = page.look(_TEXT.replace("BYTES", script))
    pixels = np.frombuffer(b64decode(text), np.uint8).reshape(view.height_px, view.width_px, 4)
    return pixels[..., :3], pixels[..., 3] > 0
