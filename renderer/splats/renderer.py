"""Rendering of a packed scene in four passes.

Paper: HPG 2021, section 3.6, after Botsch et al. 2005: cull groups into indirect draws, draw depth pushed back by a
margin, add up weighted colours of all splats within the margin, divide.

A draw is one batch of one group: its splats' triangles, by an index list that all groups share. One indirect call draws
a batch in all groups; the base vertex of a draw names its group.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter

import moderngl
import numpy as np

from renderer.effects import defines_of
from renderer.effects.relighting import AS_PHOTOGRAPHED, Light, usual_light
from renderer.splats.baseline import PhotoSplats
from renderer.splats.context import gl_context
from renderer.splats.detail import FINEST, Detail
from renderer.splats.programs import Programs, set_uniforms
from renderer.splats.projection import checked_view, larger, view_block
from renderer.splats.scene import DRAWS, GpuScene
from renderer.splats.targets import NARROW, WIDE, Picture, Targets, make_targets, read_alpha
from storage.packed.schema import GROUP, MAX_ATOMS, Camera

_INVOCATIONS = 64  # local size of cull.comp.glsl
_VIEW_BYTES = 7 * 16


@dataclass
class _Frame:
    targets: Targets
    light: Light
    pass_seconds: dict[str, float] = field(default_factory=dict)
    programs: list[str] = field(default_factory=list)


class Renderer:
    """Draws packed scenes into pictures. Of one context, and so of one thread.

    Guarantees: no NaN and no Inf reaches a picture; splats behind the camera, at its plane and around the eye are
    drawn as far as they are in front of it; a splat smaller than a pixel still covers one; however many splats lie on
    top of each other, a picture is within 1/255 of exact sums, but where the job asked for `accumulation=off` (and but
    for inputs that docs/NUMERICS.md names). With `antialias` N each pixel is the mean of N x N (targets.py), or of
    fewer where the driver has no textures so large.
    """

    def __init__(self, context: moderngl.Context | None = None, antialias: int = 1) -> None:
        self.context, self.antialias = context or gl_context(), antialias
        with self.context:
            self._programs = Programs(self.context)
            self._view = self.context.buffer(reserve=_VIEW_BYTES)
            self._none = self.context.simple_framebuffer(
                (1, 1)
            )  # bound when targets are released: moderngl would bind those again
        self._targets: Targets | None = None

    def render(
        self,
        gpu_scene: GpuScene,
        view: Camera,
        max_atoms: int = MAX_ATOMS,
        light: Light | None = None,
        detail: Detail = Detail(),
    ) -> Picture:
        """The scene from `view`, of each splat the `max_atoms` atoms of the largest weights; lit where its effects say
        that it can be, by default as it was photographed, or by a lamp where its colours have no light in them; of
        levels what `detail` asks for.

        Raises: InvalidScan for a view that is not finite, ResourceExhausted for one too large.
        """
        times = self.times_of(checked_view(view))
        gpu_scene.show(larger(view, times), detail.of_parts(times))
        if gpu_scene.pages is not None:
            gpu_scene.pages.look(view)
        return self._drawn(
            gpu_scene,
            view,
            lambda frame: self._draw_attributes(frame, gpu_scene, max_atoms),
            light or usual_light(gpu_scene.scene.header),
        )

    def render_baseline(self, photos: PhotoSplats, view: Camera) -> Picture:
        """The splats of the finest level from `view`, textured from the photographs themselves: what compression is
        compared with."""

        def draw(frame: _Frame) -> None:
            self._begin_attributes(frame)
            frame.programs += photos.draw(self._programs, view)

        photos.gpu_scene.show(larger(view, self.times_of(checked_view(view))), FINEST)
        return self._drawn(photos.gpu_scene, view, draw, AS_PHOTOGRAPHED)

    def render_by_parts(self, gpu_scene: GpuScene, view: Camera, parts: Callable[[], Iterator[int]]) -> Picture:
        """The splats of the finest level from `view`, textured from the pages of a scene with them, in as many parts as
        `parts()` yields numbers, from 0 on: before each it has its pages put and counted (`GpuPages.count`)."""
        assert gpu_scene.pages is not None
        gpu_scene.show(larger(view, self.times_of(checked_view(view))), FINEST)
        gpu_scene.pages.look(view)

        def draw(frame: _Frame) -> None:
            with gpu_scene.pages.drawn_by_parts():
                for part in parts():
                    gpu_scene.pages.uniforms["first_part"] = part == 0
                    self._draw_attributes(frame, gpu_scene, 0, part)
                    self.context.finish()  # llvmpipe draws later, from what the pool holds by then

        return self._drawn(gpu_scene, view, draw, AS_PHOTOGRAPHED)

    def times_of(self, view: Camera) -> int:
        """How many times as large a view is drawn."""
        return max(
            1, min(self.antialias, self.context.info["GL_MAX_TEXTURE_SIZE"] // max(view.width_px, view.height_px))
        )

    def flatten_feedback(self, gpu_scene: GpuScene) -> None:
        """List the pages that the last frame of a scene with pages asked for; `gpu_scene.pages.listed` has them."""
        assert gpu_scene.pages is not None
        with self.context:
            _, program = self._programs.compute("flatten_feedback")
        gpu_scene.pages.flatten(program)

    # --- passes ------------------------------------------------------------------------------------------------------

    def _drawn(
        self, gpu_scene: GpuScene, view: Camera, draw_attributes: Callable[[_Frame], None], light: Light
    ) -> Picture:
        """A picture whose sums are as wide as the scene's overdraw calls for; a scene that once did keeps wide ones."""
        with self.context:
            picture, overdrawn = self._pass_by_pass(gpu_scene, view, draw_attributes, light)
            if overdrawn and picture.accumulation == NARROW:
                gpu_scene.accumulation = WIDE
                picture, _ = self._pass_by_pass(gpu_scene, view, draw_attributes, light)
        return picture

    def _pass_by_pass(
        self, gpu_scene: GpuScene, view: Camera, draw_attributes: Callable[[_Frame], None], light: Light
    ) -> tuple[Picture, bool]:
        frame = self._begin(gpu_scene, view, light)
        with self._pass(frame, "visibility"):
            self._draw_depth(frame, gpu_scene)
        with self._pass(frame, "attribute"):
            draw_attributes(frame)
        return self._finish(frame, gpu_scene)

    def _begin(self, gpu_scene: GpuScene, view: Camera, light: Light) -> _Frame:
        checked_view(view)
        smooth = "normal_smoothing" in gpu_scene.drawn
        size, times = (view.width_px, view.height_px), self.times_of(view)
        frame = _Frame(self._targets_of(size, gpu_scene.accumulation, smooth, times), light)
        self._view.write(view_block(larger(view, times), gpu_scene.scene.header))
        self._view.bind_to_uniform_block(0)
        gpu_scene.bind()
        with self._pass(frame, "cull"):
            defines = {name: gpu_scene.defines[name] for name in ("DETAIL", "FRONT")}
            name, program = self._programs.compute("cull", **defines, LOOKED_UP=int(len(gpu_scene.looks) > 1))
            frame.programs.append(name)
            program.run(-(-gpu_scene.scene.header.n_groups // _INVOCATIONS))
            self.context.memory_barrier(moderngl.Context.COMMAND_BARRIER_BIT)
        return frame

    def _draw_depth(self, frame: _Frame, gpu_scene: GpuScene) -> None:
        frame.targets.visibility.use()
        frame.targets.visibility.clear(depth=0.0)
        self.context.enable_only(moderngl.DEPTH_TEST)
        self.context.depth_func = ">"
        for window in self._windows(frame, gpu_scene):
            self._draw_depth_of(frame, gpu_scene, window)

    def _draw_depth_of(self, frame: _Frame, gpu_scene: GpuScene, window: range) -> None:
        batches, n_leading = gpu_scene.scene.header.batches, gpu_scene.n_leading
        if n_leading:  # atoms do not matter here: all at once
            for look in gpu_scene.looks:
                name, drawing = self._programs.drawing(
                    "visibility", LEADING=int(n_leading < len(batches)), **(_defines_drawn(gpu_scene) | look.defines)
                )
                set_uniforms(drawing, n_leading=n_leading)
                self._draw_groups(gpu_scene, drawing, look.first_row + len(batches), window)
                frame.programs.append(name)
        for batch in range(n_leading, len(batches)):
            defines = defines_of("visibility", gpu_scene.drawn, batches[batch])
            self._draw_batch(frame, gpu_scene, batch, window, "visibility", **defines, **_defines_drawn(gpu_scene))

    def _draw_attributes(self, frame: _Frame, gpu_scene: GpuScene, max_atoms: int, part: int | None = None) -> None:
        """All batches; the `part`-th time of several that add up to a picture, or once."""
        self._begin_attributes(frame, clears=not part)
        for window in self._windows(frame, gpu_scene):
            self._draw_attributes_of(frame, gpu_scene, max_atoms, part, window)

    def _draw_attributes_of(
        self, frame: _Frame, gpu_scene: GpuScene, max_atoms: int, part: int | None, window: range
    ) -> None:
        paged, by_part = gpu_scene.pages is not None, part is not None
        asks = paged and gpu_scene.pages.asks and not by_part
        of_pages = {"PAGES": int(paged), "BY_PART": int(by_part), "ASKS": int(asks)}
        for batch, kind in enumerate(gpu_scene.scene.header.batches):
            n_atoms = min(kind.n_atoms, max_atoms)
            turned = int(gpu_scene.scene.header.n_turns > 1 and n_atoms > 0)
            of_atoms = gpu_scene.drawn if n_atoms else gpu_scene.drawn - {"mip_levels", "level_blending"}
            of_codes = {"N_ATOMS": n_atoms, "FEWER": int(0 < n_atoms < kind.n_atoms), "TURNED": turned}
            defines = {**of_codes, **defines_of("attribute", of_atoms, kind), **of_pages}
            self._draw_batch(frame, gpu_scene, batch, window, "attribute", **defines, **_defines_drawn(gpu_scene))

    def _begin_attributes(self, frame: _Frame, clears: bool = True) -> None:
        frame.targets.attribute.use()
        if clears:
            frame.targets.attribute.clear()
        self.context.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        self.context.depth_func = ">="
        self.context.blend_func = moderngl.ONE, moderngl.ONE

    def _finish(self, frame: _Frame, gpu_scene: GpuScene) -> tuple[Picture, bool]:
        """The picture, and whether any of its pixels is overdrawn; sums that are wide, or are to stay narrow, are not
        watched."""
        with self._pass(frame, "resolve"):
            frame.targets.resolve.use()
            self.context.enable_only(moderngl.NOTHING)
            frame.targets.sums.use(0)
            if frame.targets.normals is not None:
                frame.targets.normals.use(1)
            watched = gpu_scene.watched and frame.targets.accumulation == NARROW
            name, drawing = self._programs.drawing(
                "resolve",
                **defines_of("resolve", gpu_scene.drawn),
                WATCHED=int(watched),
                TIMES=frame.targets.times if frame.targets.times > 1 else 0,
            )
            set_uniforms(drawing, **_lamp_of(frame))
            drawing.render(moderngl.TRIANGLES, vertices=3)
            frame.programs.append(name)
        width, height = frame.targets.size
        pixels = np.frombuffer(frame.targets.resolve.read(components=4), np.uint8).reshape(height, width, 4)
        programs = tuple(dict.fromkeys(frame.programs))
        rgb, (alpha, overdrawn) = pixels[..., :3].copy(), read_alpha(pixels[..., 3], watched)
        return Picture(rgb, alpha, frame.pass_seconds, programs, frame.targets.accumulation), overdrawn

    # --- helpers -----------------------------------------------------------------------------------------------------

    def _windows(self, frame: _Frame, gpu_scene: GpuScene) -> Iterator[range]:
        """The groups to draw, window by window where they are decoded for that."""
        if gpu_scene.decoded is None:
            yield range(gpu_scene.scene.header.n_groups)
            return
        name, program = self._programs.compute("decode_quadrics", **gpu_scene.defines)
        frame.programs.append(name)
        yield from gpu_scene.decoded.windows(program, gpu_scene.is_chosen)

    def _draw_batch(
        self, frame: _Frame, gpu_scene: GpuScene, batch: int, window: range, name: str, **defines: int
    ) -> None:
        batches = gpu_scene.scene.header.batches
        # So no splat needs to be looked for; where the group has other batches too, its rows are not those of codes.
        leads = batch == 0 and gpu_scene.n_leading == 1 and (len(batches) == 1 or not batches[0].n_atoms)
        for look in gpu_scene.looks:
            program, drawing = self._programs.drawing(
                name, **(defines | look.defines), BY_BATCH=int(not leads), LEADING=int(leads and len(batches) > 1)
            )
            set_uniforms(drawing, batch=batch, n_leading=1, atoms_stored=batches[batch].n_atoms, **_lamp_of(frame))
            if gpu_scene.pages is not None:
                set_uniforms(drawing, **gpu_scene.pages.uniforms)
            self._draw_groups(gpu_scene, drawing, look.first_row + (len(batches) if leads else batch), window)
            frame.programs.append(program)

    @staticmethod
    def _draw_groups(gpu_scene: GpuScene, drawing: moderngl.VertexArray, row: int, window: range) -> None:
        set_uniforms(drawing, first_decoded=window.start * GROUP)
        first = row * gpu_scene.scene.header.n_groups + window.start
        drawing.render_indirect(gpu_scene.buffers[DRAWS], moderngl.TRIANGLES, len(window), first)

    @contextmanager
    def _pass(self, frame: _Frame, name: str) -> Iterator[None]:
        started = perf_counter()
        yield
        self.context.finish()
        frame.pass_seconds[name] = perf_counter() - started

    def _targets_of(self, size: tuple[int, int], accumulation: str, smooth: bool, times: int) -> Targets:
        kept, wanted = self._targets, (size, times, accumulation, smooth)
        if kept is None or (kept.size, kept.times, kept.accumulation, kept.normals is not None) != wanted:
            if self._targets is not None:
                self._none.use()
                self._targets.release()
                self._targets = None
            self._targets = make_targets(self.context, size, accumulation, smooth, times)
        return self._targets


def _defines_drawn(gpu_scene: GpuScene) -> dict[str, int]:
    """What the programs that draw splats are compiled with."""
    return {**gpu_scene.defines, "DECODED": int(gpu_scene.decoded is not None)}


def _lamp_of(frame: _Frame) -> dict:
    """The uniforms of shaders/lamp.glsl."""
    return {"towards_light": frame.light.towards, "ambient": frame.light.ambient, "diffuse": frame.light.diffuse}
