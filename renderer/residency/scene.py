"""The splats of a packed file, with the places of their middles in its photographs."""

from __future__ import annotations

import numpy as np

from pipeline.splats.decoded import scene_radii
from pipeline.stages.packed.measure import scene_squares
from renderer.residency.labels import smoothed_labels
from renderer.residency.places import Places, places_of
from storage.packed.scene import PackedScene


def scene_places(scene: PackedScene, magnified: int = 1, page_px: int = 128, smooth: bool = True) -> Places:
    """The splats of the finest level that have a photograph; of labels that agree with their neighbours, where `smooth`."""
    finest = slice(scene.header.first_finest, None)
    centre, (u, v) = scene_squares(scene)
    centre, normal = centre[finest] + np.array(scene.header.origin), np.cross(u[finest], v[finest])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    radius, camera = scene_radii(scene)[finest], scene.arrays["camera"][finest]
    if smooth:
        camera = smoothed_labels(centre, normal, radius, camera, scene.header.cameras)
    return places_of(centre, radius, normal, camera, scene.header.cameras, magnified, page_px)
