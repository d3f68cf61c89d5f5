"""A path with a manager of pages, in simulated time: how often a page is missing, by prediction and policy.

Deterministic: frames come at 90 a second, feedback arrives after 2 of them, what was asked for is loaded after 6. No
disk and no clock take part, so that policies are compared, not machines.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from renderer.residency.manager import MAPPED, Manager
from renderer.residency.paths import FRAMES_PER_SECOND, Path90
from renderer.residency.places import Places, Screen
from renderer.residency.prediction import PREDICTIONS, Parts, motion_at, parts_of

POLICIES = ("default", "paper")
BUDGETS = ((16, 4000), (12, 3000), (8, 2500))  # pages a frame, pages in the pool
NOTHING = np.empty(0, np.int64)
FEEDBACK_FRAMES, LOAD_FRAMES = 2, 6
SETTLED_FRAMES = 90  # beyond those that a full pool takes: a viewer stands still until what it shows is there
THREADS = 4
QUIET_FRAMES = 12  # without a page that comes or goes: what is asked for is there
SCREEN = Screen(1440, 1560, 720.0)  # an eye of a headset, 90 degrees across


@dataclass(frozen=True)
class Misses:
    """Of one path, prediction and policy."""

    pixels: float  # share of the pixels drawn whose page is not there, averaged over frames
    pages: float  # pages missing, averaged over frames
    wanted: float  # pages wanted a frame, averaged
    loaded: int
    evicted: int


def parts_along(places: Places, path: Path90, distance: float) -> list[dict[str, Parts]]:
    """What the frames of a path may ask for, by policy: depends on neither pool nor bandwidth nor prediction."""

    def of_frame(i: int) -> dict[str, Parts]:
        motion = motion_at(path.poses, i, FRAMES_PER_SECOND)
        return parts_of(places, path.poses[i], motion, SCREEN, distance, i)

    with ThreadPoolExecutor(THREADS) as threads:  # kernels let others run
        return list(threads.map(of_frame, range(len(path.poses))))


def misses_of(
    places: Places, parts: list[Parts], prediction: str, n_frame: int, n_pool: int, published: bool, cold: bool = False
) -> Misses:
    """Run the manager over the frames of a path, once it has settled on the first; `cold` from the first frame on, with
    tails alone."""
    layout = places.layout
    manager = Manager(layout.level_of, layout.parents, n_pool, n_frame, published)
    asked = [part.asked(prediction) for part in parts]
    under_way: list[tuple[int, np.ndarray]] = []
    pixels, pages, wanted, n_loaded, n_evicted = [], [], [], 0, 0
    i, clock, n_quiet = 0 if cold else -(SETTLED_FRAMES + -(-n_pool // n_frame)), 0, 0
    while i < len(parts):
        if i >= 0:
            required = parts[i].required
            missing = manager.state[required.page] != MAPPED
            pixels.append(float(required.pixels[missing].sum() / max(1.0, required.pixels.sum())))
            pages.append(int(missing.sum()))
            wanted.append(asked[i].n_pages)
        heard = asked[max(0, i - FEEDBACK_FRAMES)] if clock >= FEEDBACK_FRAMES else None
        loaded = [pages_ for due, pages_ in under_way if due <= clock]
        under_way = [(due, pages_) for due, pages_ in under_way if due > clock]
        orders = manager.step(clock, heard, np.concatenate([NOTHING, *loaded]))
        if len(orders.load):
            under_way.append((clock + LOAD_FRAMES, orders.load))
        if i >= 0:
            n_loaded, n_evicted = n_loaded + len(orders.load), n_evicted + len(orders.evict)
        quiet = not (under_way or len(orders.map) or len(orders.evict))
        n_quiet = n_quiet + 1 if quiet else 0
        i, clock = 0 if i < 0 and n_quiet > QUIET_FRAMES else i + 1, clock + 1
    return Misses(float(np.mean(pixels)), float(np.mean(pages)), float(np.mean(wanted)), n_loaded, n_evicted)


@dataclass(frozen=True)
class Row:
    """One cell of Table 1: what was missing, and that against no prediction."""

    path: str
    policy: str
    prediction: str
    n_frame: int
    n_pool: int
    misses: Misses
    pixels_of_nothing: float | None  # against the same policy without prediction; None where that misses nothing
    pages_of_nothing: float | None
    pixels_of_published: float | None  # against the published policy without prediction
    pages_of_published: float | None
    cold: bool = False  # whether the viewer came in at once, with nothing loaded


def rows_of_path(
    places: Places,
    path: Path90,
    distance: float,
    budgets: tuple[tuple[int, int], ...] = BUDGETS,
    starts: tuple[bool, ...] = (False,),
) -> list[Row]:
    """The rows of one path, of all policies and predictions (2020, Table 1), for each of `starts`, cold or not."""
    both = parts_along(places, path, distance)
    rows = []
    for (n_frame, n_pool), cold in ((budget, cold) for cold in starts for budget in budgets):
        found = {
            policy: _by_prediction(places, [parts[policy] for parts in both], n_frame, n_pool, policy == "paper", cold)
            for policy in POLICIES
        }
        published = found["paper"]["nothing"]
        for policy, by_prediction in found.items():
            own = by_prediction["nothing"]
            for prediction, misses in by_prediction.items():
                shares = (_share(misses, own), _share(misses, published))
                rows.append(Row(path.name, policy, prediction, n_frame, n_pool, misses, *shares[0], *shares[1], cold))
    return rows


def _by_prediction(
    places: Places, parts: list[Parts], n_frame: int, n_pool: int, published: bool, cold: bool
) -> dict[str, Misses]:
    found: dict[str, Misses] = {}
    unbiased = not any(part.bias.n_pages for part in parts)  # then a prediction with bias is the one without
    for prediction in PREDICTIONS:
        same = {"bias": "nothing", "combined": "frustum"}.get(prediction) if unbiased else None
        found[prediction] = (
            found[same] if same else misses_of(places, parts, prediction, n_frame, n_pool, published, cold)
        )
    return found


def _share(misses: Misses, of: Misses) -> tuple[float | None, float | None]:
    return (
        misses.pixels / of.pixels if of.pixels else None,
        misses.pages / of.pages if of.pages else None,
    )
