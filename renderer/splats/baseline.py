"""The baseline: splats textured from the photographs they were resampled from, at their full resolution.

What compression is measured against (HPG 2021, section 4). The geometry and the passes are those of the packed scene;
only the colour of a fragment comes from the photo of its splat's camera, at the pixel that the fragment's point on the
disc projects to. Photographs are bound one at a time and kept while they fit a budget, so many large ones will do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import moderngl
import numpy as np

from pipeline.geometry.cliplines import encode_cliplines
from renderer.effects import defines_of
from renderer.splats.programs import Programs, set_uniforms
from renderer.splats.projection import view_to_photo
from renderer.splats.scene import CLIPLINES, CODES, DRAW_BYTES, ELLIPSOIDS, GpuScene, storage_buffer
from storage.errors import InvalidScan, ResourceExhausted
from storage.packed.bits import unpack_bits
from storage.packed.packed import PackedScene
from storage.packed.schema import CLIPLINE_BITS, GROUP, NO_CAMERA, Camera

PHOTO_BUDGET_BYTES = 1 << 29
_NO_CLIPLINE = int(encode_cliplines(np.array([[0.0, 0.0, 1.0]]))[0])  # keeps the whole disc


def texture_bytes(cameras: Sequence[Camera]) -> int:
    """What photographs take as textures with mip levels."""
    return sum(3 * c.width_px * c.height_px for c in cameras) * 4 // 3


def splats_by_camera(scene: PackedScene) -> tuple[np.ndarray, dict[tuple[int, bool], tuple[int, int]]]:
    """The splats of the finest level sorted by their camera, of each first discs, then ellipsoids; and of each such run
    its (first, number)."""
    camera = scene.arrays.get("camera")
    if camera is None:
        camera = np.full(scene.header.n_splats, NO_CAMERA, np.uint16)
    key = 2 * camera.astype(np.int64) + (scene.rows.extra["ellipsoid"] >= 0)
    order = np.argsort(key, kind="stable")
    order = order[order >= scene.header.first_finest].astype(np.uint32)
    present, first, number = np.unique(key[order], return_index=True, return_counts=True)
    return order, {(int(k) // 2, bool(k % 2)): (int(f), int(n)) for k, f, n in zip(present, first, number, strict=True)}


def ellipsoid_words(scene: PackedScene) -> np.ndarray:
    """The ellipsoid of every splat (n,) uint32, 0 where it is a disc."""
    words = np.zeros(scene.header.n_splats, np.uint32)
    splat, fields = scene.ellipsoids
    words[splat] = fields.view("<u4")[:, 0]
    return words


def clipline_codes(scene: PackedScene) -> np.ndarray:
    """The clipline code of every splat (n,) uint32; one that clips nothing for splats without."""
    codes = np.full(scene.header.n_splats, _NO_CLIPLINE, np.uint32)
    has_line = np.flatnonzero(scene.rows.clipline >= 0)
    first_word = scene.arrays["clipline_word"][has_line // GROUP].astype(np.int64)
    first_bit = first_word * 32 + scene.rows.clipline[has_line] * CLIPLINE_BITS
    codes[has_line] = unpack_bits(scene.arrays["cliplines"], first_bit, CLIPLINE_BITS)
    return codes


class PhotoSplats:
    """The splats of an uploaded scene, listed by camera, and their photographs.

    `read_photo(i)` returns the photo of `cameras[i]`, by default the header's, as (height, width, 3) uint8 sRGB. Splats
    without a camera have their average colour.
    """

    def __init__(
        self,
        gpu_scene: GpuScene,
        read_photo: Callable[[int], np.ndarray],
        photo_budget_bytes: int = PHOTO_BUDGET_BYTES,
        cameras: Sequence[Camera] | None = None,
    ) -> None:
        self._cameras = cameras or gpu_scene.scene.header.cameras
        self.gpu_scene = gpu_scene
        self._context = gpu_scene.context
        self._read_photo = read_photo
        self._budget_bytes = photo_budget_bytes
        self._kept: dict[int, moderngl.Texture] = {}
        order, self._spans = splats_by_camera(gpu_scene.scene)
        with self._context:
            self._listed = storage_buffer(self._context, order, "splats by camera")
            self._lines = None
            if gpu_scene.has_cliplines:
                lines = clipline_codes(gpu_scene.scene)[order]
                self._lines = storage_buffer(self._context, lines, "cliplines by camera")
            self._ellipsoids = None
            if gpu_scene.has_ellipsoids:
                words = ellipsoid_words(gpu_scene.scene)[order]
                self._ellipsoids = storage_buffer(self._context, words, "ellipsoids by camera")
            longest = max(number for _, number in self._spans.values())
            self._draws = self._context.buffer(reserve=-(-longest // GROUP) * DRAW_BYTES)

    def draw(self, programs: Programs, view: Camera) -> list[str]:
        """Draw all splats, camera by camera, into the bound framebuffer; returns the names of the programs used."""
        self._listed.bind_to_storage_buffer(CODES)
        if self._lines is not None:
            self._lines.bind_to_storage_buffer(CLIPLINES)
        if self._ellipsoids is not None:
            self._ellipsoids.bind_to_storage_buffer(ELLIPSOIDS)
        return [self._draw_camera(programs, view, *run) for run in self._spans]

    def release(self) -> None:
        for resource in (self._listed, self._lines, self._ellipsoids, self._draws, *self._kept.values()):
            if resource is not None:
                resource.release()
        self._kept = {}

    def _draw_camera(self, programs: Programs, view: Camera, camera: int, ellipsoid: bool) -> str:
        first, number = self._spans[camera, ellipsoid]
        has_photo = camera != NO_CAMERA
        name, drawing = programs.drawing(
            "baseline",
            CLIPLINE=int(self._lines is not None and not ellipsoid),
            ELLIPSOID=int(ellipsoid),
            **defines_of("baseline", self.gpu_scene.drawn),
            PHOTO=int(has_photo),
            **self.gpu_scene.defines,
        )
        set_uniforms(drawing, first_listed=first)
        photo = None
        if has_photo:
            photo = self._photo(camera)
            photo.use(0)
            matrix = view_to_photo(view, self._cameras[camera])
            drawing.program["photo"].write(matrix.T.astype(np.float32).tobytes())
        draws = draws_of(number)
        self._draws.write(draws.tobytes())
        drawing.render_indirect(self._draws, moderngl.TRIANGLES, len(draws))
        if photo is not None and camera not in self._kept:
            photo.release()
        return name

    def _photo(self, camera: int) -> moderngl.Texture:
        if camera not in self._kept:
            texture, n_bytes = self._upload_photo(camera)
            if n_bytes > self._budget_bytes:
                return texture
            self._budget_bytes -= n_bytes
            self._kept[camera] = texture
        return self._kept[camera]

    def _upload_photo(self, index: int) -> tuple[moderngl.Texture, int]:
        """A photo as a texture with mip levels, and its bytes. Filtered in sRGB, as the resampling of patches is."""
        camera = self._cameras[index]
        pixels, shape = self._read_photo(index), (camera.height_px, camera.width_px, 3)
        if pixels.shape != shape or pixels.dtype != np.uint8:
            found = f"{pixels.dtype} of shape {pixels.shape}"
            raise InvalidScan(f"photo {camera.name!r}", found, f"uint8 of shape {shape}")
        limit = self._context.info["GL_MAX_TEXTURE_SIZE"]
        if max(shape) > limit:
            raise ResourceExhausted(f"photo {camera.name!r}", f"{shape[1]}x{shape[0]} px", f"{limit} px to a side")
        texture = self._context.texture((camera.width_px, camera.height_px), 3, np.ascontiguousarray(pixels).tobytes())
        texture.build_mipmaps()
        texture.filter = moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR
        texture.repeat_x = texture.repeat_y = False
        return texture, pixels.nbytes * 4 // 3


def draws_of(n_splats: int) -> np.ndarray:
    """Indirect draws of consecutive splats, GROUP at most in each: (n, 5) uint32 as in cull.comp.glsl."""
    first = np.arange(0, n_splats, GROUP)
    draws = np.zeros((len(first), 5), np.uint32)
    draws[:, 0] = 3 * np.minimum(GROUP, n_splats - first)
    draws[:, 1] = 1
    draws[:, 3] = 4 * first
    return draws
