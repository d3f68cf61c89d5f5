"""A path drawn with pages: what each frame asks for is loaded, mapped and evicted by the manager while it goes on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np

from renderer.residency.feedback import BIAS, MARGIN, POSE, REQUIRED, Feedback, merged, with_ancestors
from renderer.residency.loader import PageLoader
from renderer.residency.manager import LOADED, LOADING, SEEN, Manager
from renderer.residency.places import Places, Pose, Screen
from renderer.residency.prediction import (
    AHEAD_S,
    FULL_SPEED,
    HALVING,
    MARGIN_SHARE,
    PUBLISHED_BIAS,
    PUBLISHED_MARGIN,
    Motion,
    ahead,
    shift_px,
)  # fmt: skip
from renderer.residency.simulate import LOAD_FRAMES, SETTLED_FRAMES
from renderer.splats.renderer import Picture, Renderer
from renderer.splats.scene import GpuScene
from storage.errors import ResourceExhausted
from storage.packed.schema import Camera
from storage.pages.file import PageFile

STALL_S = 0.25  # that a frame waits for pages that are due; then it goes on with what is there
TAIL_S = 10.0  # that a flight waits for a page that is always resident
STALLED_FRAMES = 40  # in a row with pages that are late: then nobody waits any more


@dataclass(frozen=True)
class FrameRecord:
    """What a frame cost and missed."""

    pass_ms: dict[
        str, float
    ]  # of the GPU's passes, the list of what they ask for, and reading, predicting, managing, uploading
    wanted: int  # pages that its pixels asked for
    missed: int  # of them not there
    missed_pixels: float  # share of fragments
    loaded: int
    mapped: int
    evicted: int
    late: int  # pages that were due and had not been read


@dataclass
class Flight:
    """A scene with pages, under way. `places` are its splats with the labels that the GPU has."""

    renderer: Renderer
    scene: GpuScene
    places: Places
    file: PageFile
    screen: Screen
    distance: float
    prediction: str = "combined"
    published: bool = False
    n_frame: int = 16
    _manager: Manager = field(init=False)
    _loader: PageLoader = field(init=False)
    _due: list[tuple[int, int]] = field(default_factory=list)  # frame, page
    _waiting: set[int] = field(default_factory=set)  # read, and not mapped yet
    _frame: int = 0
    _ms: dict[str, float] = field(default_factory=dict)  # of the frame under way

    def __post_init__(self) -> None:
        layout, pages = self.file.layout, self.scene.pages
        assert pages is not None
        tails = np.flatnonzero(layout.is_tail)
        self._manager = Manager(
            layout.level_of, layout.parents, pages.shape.n_pages - len(tails), self.n_frame, self.published
        )
        self._loader = PageLoader(self.file, self.n_frame * (LOAD_FRAMES + 64) + 1)
        try:
            self._put_tails(tails)
        except BaseException:
            self.close()
            raise

    def _put_tails(self, tails: np.ndarray) -> None:
        pages = self.scene.pages
        assert pages is not None
        for page in tails.tolist():
            self._loader.request(page)
            if not self._loader.ready([page], TAIL_S):
                found = f"page {page} not read within {TAIL_S:g} s"
                raise ResourceExhausted(str(self.file.path), found, "a disk that answers")
            pages.put(page, self._loader.texels(page))
            self._loader.give_back(page)

    @property
    def most_settling(self) -> int:
        """Frames that a viewer stands still at most, as in simulation: those that a full pool takes, and
        SETTLED_FRAMES."""
        assert self.scene.pages is not None
        return SETTLED_FRAMES + -(-self.scene.pages.shape.n_pages // self.n_frame)

    def settle(self, pose: Pose) -> int:
        """Stand still until nothing more is loaded, for `most_settling` frames, or until the disk stalls; returns how
        many frames it took. In a pool that does not hold what a view asks for pages come and go without end."""
        n_late = 0
        for n in range(self.most_settling):
            _, record = self.frame(pose, Motion(np.zeros(3), np.zeros(3)))
            n_late = n_late + 1 if record.late else 0
            if n_late == STALLED_FRAMES:
                return n
            if n > LOAD_FRAMES and not self._due and not (np.isin(self._manager.state, (SEEN, LOADING, LOADED))).any():
                return n
        return self.most_settling

    def frame(self, pose: Pose, motion: Motion) -> tuple[Picture, FrameRecord]:
        """Draw one frame; then the pages that it asked for may come."""
        pages = self.scene.pages
        assert pages is not None
        counts = self._advance(pose, motion)
        view, margin = self._view(pose, motion)
        pages.show_all(view.width_px, view.height_px, margin)
        there = pages.slot_of > 0
        picture = self.renderer.render(self.scene, view)
        with self._timed("feedback"):
            self.renderer.flatten_feedback(self.scene)
            rows, _ = pages.listed(1)
        required = rows[rows[:, 1] > 0]
        missing = ~there[required[:, 0]]
        total = max(1, int(required[:, 1].sum()))
        left, top, right, bottom = margin
        inside = np.s_[top : view.height_px - bottom, left : view.width_px - right]
        shown = Picture(
            picture.rgb[inside], picture.alpha[inside], picture.pass_seconds, picture.programs, picture.accumulation
        )
        return shown, FrameRecord(
            {name: 1000 * seconds for name, seconds in picture.pass_seconds.items()} | self._ms,
            len(required),
            int(missing.sum()),
            float(required[missing, 1].sum() / total),
            *counts,
        )

    def close(self) -> None:
        self._loader.close()

    def _advance(self, pose: Pose, motion: Motion) -> tuple[int, int, int, int]:
        """What the manager orders, done: loaded, mapped, evicted; and what came late."""
        pages, manager = self.scene.pages, self._manager
        assert pages is not None
        due = [page for frame, page in self._due if frame <= self._frame]
        with self._timed("read"):
            ready = self._loader.ready(due, STALL_S)
        came = set(ready)
        self._due = [(frame, page) for frame, page in self._due if page not in came]
        with self._timed("predict"):
            predicted = self._predicted(pose, motion)
        with self._timed("manage"):
            orders = manager.step(self._frame, self._heard(predicted), np.array(ready, np.int64))
        with self._timed("upload"):
            for page in orders.evict.tolist():
                pages.drop(page)
            for page in orders.map.tolist():
                pages.put(page, self._loader.texels(page))
                self._loader.give_back(page)
                self._waiting.discard(page)
        self._waiting |= came - set(orders.map.tolist())
        for page in [page for page in self._waiting if manager.state[page] != LOADED]:  # forgotten
            self._loader.give_back(page)
            self._waiting.discard(page)
        load = orders.load[: self._loader.n_free]
        manager.failed(orders.load[len(load) :])
        for page in load.tolist():
            self._loader.request(page)
            self._due.append((self._frame + LOAD_FRAMES, page))
        self._frame += 1
        return len(load), len(orders.map), len(orders.evict), len(due) - len(ready)

    @contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        begun = perf_counter()
        yield
        self._ms[name] = 1000 * (perf_counter() - begun)

    def _heard(self, predicted: list[Feedback]) -> Feedback | None:
        pages = self.scene.pages
        assert pages is not None
        rows, _ = pages.listed(2)
        if not len(rows):
            return None
        page, in_view, in_margin = rows.astype(np.int64).T
        seen = in_view > 0
        found = Feedback(
            page,
            np.where(seen, REQUIRED, MARGIN).astype(np.int8),
            np.where(seen, in_view, in_margin).astype(np.float64),
            np.zeros(len(page), np.uint8),
        )
        parts = [found, *predicted]
        if self.published:
            return merged(parts)
        return merged([with_ancestors(part, self.file.layout.parents) for part in parts])

    def _predicted(self, pose: Pose, motion: Motion) -> list[Feedback]:
        """By the small picture of places: poses ahead (default policy), and the bias."""
        parts = []
        if self.prediction in ("frustum", "combined") and not self.published:
            seconds = AHEAD_S[self._frame % len(AHEAD_S)]
            parts.append(self.places.seen(ahead(pose, motion, seconds), self.screen, 2 * HALVING).wanted(POSE))
        if self.prediction in ("bias", "combined"):
            speed = 1.0 if self.published else float(np.clip(motion.linear[2] / (FULL_SPEED * self.distance), 0, 1))
            if speed:
                seen = self.places.seen(pose, self.screen, HALVING)
                parts.append(seen.wanted(BIAS, PUBLISHED_BIAS * speed))
        return parts

    def _view(self, pose: Pose, motion: Motion) -> tuple[Camera, tuple[int, int, int, int]]:
        """The view with the margin that is predicted by, and left, top, right and bottom of that margin in px."""
        s = self.screen
        margin = (0, 0, 0, 0)
        if self.prediction in ("frustum", "combined"):
            share = PUBLISHED_MARGIN if self.published else MARGIN_SHARE
            x, y = shift_px(motion, s, share, self.distance)
            wide, high = round(share * s.width_px), round(share * s.height_px)
            left, top = round(wide - x), round(high - y)
            margin = (left, top, 2 * wide - left, 2 * high - top)
        left, top, right, bottom = margin
        rotation = tuple(tuple(row) for row in np.asarray(pose.rotation).tolist())
        camera = Camera(
            "path", s.width_px + left + right, s.height_px + top + bottom, s.focal_px, s.focal_px,
            s.width_px / 2 + left, s.height_px / 2 + top, rotation, tuple(np.asarray(pose.centre).tolist()),
        )  # fmt: skip
        return camera, margin
