"""Gaussians of a packed file in the colours that make them look like the file, from where photographs were taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.exports.fitting import Target, fitted
from pipeline.exports.gaussians import Gaussians
from renderer.effects.relighting import AS_PHOTOGRAPHED
from renderer.evaluate.compare import psnr_of_error
from renderer.evaluate.previews import limited_view
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from storage.errors import ResourceExhausted
from storage.packed.packed import PackedScene
from storage.packed.schema import NO_CAMERA, Camera

MOST_FITTED = 6_000_000  # Gaussians; fitting takes 0.3 kB of memory each, and 32 bytes in each view
MOST_VIEWS, MOST_SIDE_PX = 12, 1536  # pictures that colours are fitted to


def in_own_colours(scene: PackedScene, gaussians: Gaussians, steps: int) -> tuple[Gaussians, tuple[str, ...]]:
    """Colours fitted to the file's own pictures from where photographs were taken, each level of splats by itself, and
    how far those of the finest remain from the pictures; or why they are not."""
    if not steps or not len(gaussians):
        return gaussians, ()
    views, why = views_of(scene), ""
    if not views:
        why = "no splat was textured from a photograph"
    elif len(gaussians) > MOST_FITTED:
        why = f"{len(gaussians):,} Gaussians are more than {MOST_FITTED:,}"
    else:
        try:
            targets = _targets(scene, views)
        except ResourceExhausted as error:
            why = str(error)
    if why:
        return gaussians, (f"the fit of colours to the file's own pictures: {why}",)
    level = np.searchsorted(np.cumsum(scene.header.levels or (scene.header.n_splats,)), gaussians.splat, side="right")
    color = gaussians.color.copy()
    for rows in (np.flatnonzero(level == found) for found in np.unique(level)):
        made = fitted(gaussians.of(rows), targets, steps)
        color[rows] = made.gaussians.color
    before, after = (psnr_of_error(error) for error in (made.error_before, made.error))
    told = f"likeness: pictures from {len(views)} of its cameras are {after:.1f} dB from the packed file's own"
    return replace(gaussians, color=color), (f"{told}, {before:.1f} dB before colours were fitted",)


def views_of(scene: PackedScene) -> list[Camera]:
    """Of the photographs that textured most splats, in the file's order."""
    if not scene.header.cameras:
        return []
    camera = scene.arrays["camera"]
    n_splats = np.bincount(camera[camera != NO_CAMERA], minlength=len(scene.header.cameras))
    most = np.sort(np.argsort(-n_splats, kind="stable")[:MOST_VIEWS])
    return [limited_view(scene.header.cameras[i], MOST_SIDE_PX) for i in most if n_splats[i]]


def _targets(scene: PackedScene, views: Sequence[Camera]) -> list[Target]:
    renderer = Renderer()
    gpu_scene = GpuScene(scene, renderer.context)
    try:
        pictures = [renderer.render(gpu_scene, view, light=AS_PHOTOGRAPHED) for view in views]
    finally:
        gpu_scene.release()
    return [Target(view, picture.rgb, picture.coverage) for view, picture in zip(views, pictures)]
