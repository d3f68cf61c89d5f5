"""A path with a manager of pages, in simulated time: how often a page is missing, by prediction and policy.

Deterministic: frames come at 90 a second, feedback arrives after 2 of them, what was asked for is loaded after 6. No disk
and no clock take part, so that policies are compared, not machines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from renderer.residency.manager import MAPPED, Manager
from renderer.residency.paths import FRAMES_PER_SECOND, Path90
from renderer.residency.places import Places, Screen
from renderer.residency.prediction import PREDICTIONS, Parts, motion_at, parts_of

POLICIES = ("default", "paper")
NOTHING = np.empty(0, np.int64)
FEEDBACK_FRAMES, LOAD_FRAMES = 2, 6
WARM_FRAMES = 90  # a viewer stands still before a path begins: what it shows is there
SCREEN = Screen(1440, 1560, 720.0)  # an eye of a headset, 90 degrees across


@dataclass(frozen=True)
class Misses:
    """Of one path, prediction and policy."""

    pixels: float  # share of the pixels drawn whose page is not there, averaged over frames
    pages: float  # pages missing, averaged over frames
    wanted: float  # pages wanted a frame, averaged
    loaded: int
    evicted: int


def parts_along(places: Places, path: Path90, distance: float, published: bool) -> list[Parts]:
    """What the frames of a path may ask for: depends on neither pool nor bandwidth nor prediction."""
    return [
        parts_of(places, pose, motion_at(path.poses, i, FRAMES_PER_SECOND), SCREEN, distance, published)
        for i, pose in enumerate(path.poses)
    ]


def misses_of(
    places: Places, parts: list[Parts], prediction: str, n_frame: int, n_pool: int, published: bool
) -> Misses:
    """Run the manager over the frames of a path, after WARM_FRAMES of its first."""
    layout = places.layout
    manager = Manager(layout.level_of, layout.parents, n_pool, n_frame, published)
    asked = [part.asked(prediction) for part in parts]
    under_way: list[tuple[int, np.ndarray]] = []
    pixels, pages, wanted, n_loaded, n_evicted = [], [], [], 0, 0
    for i in range(-WARM_FRAMES, len(parts)):
        if i >= 0:
            required = parts[i].required
            missing = manager.state[required.page] != MAPPED
            pixels.append(float(required.pixels[missing].sum() / max(1.0, required.pixels.sum())))
            pages.append(int(missing.sum()))
            wanted.append(asked[i].n_pages)
        heard = asked[max(0, i - FEEDBACK_FRAMES)] if i >= FEEDBACK_FRAMES - WARM_FRAMES else None
        loaded = [pages_ for due, pages_ in under_way if due <= i]
        under_way = [(due, pages_) for due, pages_ in under_way if due > i]
        orders = manager.step(i + WARM_FRAMES, heard, np.concatenate([NOTHING, *loaded]))
        under_way.append((i + LOAD_FRAMES, orders.load))
        if i >= 0:
            n_loaded, n_evicted = n_loaded + len(orders.load), n_evicted + len(orders.evict)
    return Misses(float(np.mean(pixels)), float(np.mean(pages)), float(np.mean(wanted)), n_loaded, n_evicted)


def table_1(
    places: Places, paths: dict[str, Path90], distance: float, n_frame: int, n_pool: int
) -> dict[str, dict[str, dict[str, Misses]]]:
    """Misses by policy (`default`, `paper`), prediction and path."""
    found: dict[str, dict[str, dict[str, Misses]]] = {}
    for policy in POLICIES:
        rows: dict[str, dict[str, Misses]] = {prediction: {} for prediction in PREDICTIONS}
        published = policy == "paper"
        for name, path in paths.items():
            parts = parts_along(places, path, distance, published)
            for prediction in PREDICTIONS:
                rows[prediction][name] = misses_of(places, parts, prediction, n_frame, n_pool, published)
        found[policy] = rows
    return found
