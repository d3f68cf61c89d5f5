"""The splats of a packed file, with the places of their middles in its photographs."""

from __future__ import annotations

import numpy as np

from pipeline.splats.decoded import scene_radii
from pipeline.stages.packed.measure import scene_squares
from renderer.residency.labels import smoothed_labels
from renderer.residency.places import Places, places_of
from storage.packed.scene import PackedScene


def scene_places(
    scene: PackedScene, magnified: int = 1, page_px: int = 128, smooth: bool = True
) -> tuple[Places, np.ndarray]:
    """The splats of the finest level that have a photograph, and the photograph (n_splats,) of every splat of the file:
    of labels that agree with their neighbours, where `smooth`."""
    finest = slice(scene.header.first_finest, None)
    centre, (u, v) = scene_squares(scene)
    centre, normal = centre[finest] + np.array(scene.header.origin), np.cross(u[finest], v[finest])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    radius, label = scene_radii(scene)[finest], scene.arrays["camera"].copy()
    if smooth:
        label[finest] = smoothed_labels(centre, normal, radius, label[finest], scene.header.cameras)
    places = places_of(centre, radius, normal, label[finest], scene.header.cameras, magnified, page_px)
    return places, label
