"""Which pages will be wanted soon: by mip bias, by an extended frustum, and by poses ahead (2020, section 4.3).

As published: a constant negative bias, and a margin around the view that is shifted by the viewer's velocities. By the
default rules: the view from where a viewer will be 100 and 200 ms ahead, a shifted margin, and a bias that grows with
the speed ahead, in what is visible alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from renderer.residency.feedback import BIAS, EMPTY, MARGIN, POSE, REQUIRED, Feedback, merged, with_ancestors
from renderer.residency.places import Places, Pose, Screen

PREDICTIONS = ("nothing", "bias", "frustum", "combined")
PUBLISHED_BIAS, PUBLISHED_MARGIN = -0.5, 0.15
MARGIN_SHARE = 0.10  # of the screen, on each side before the shift
AHEAD_S = (0.1, 0.2)  # in turn, one a frame: the manager asks for pages of the last two
VELOCITY_S = 1 / 30  # over which velocities are taken
FULL_TURN_RADIANS_S = np.radians(90.0)  # a head's velocity that shifts the margin all the way
FULL_SPEED = 0.5  # viewing distances a second: the same for translations, and for the whole bias
HALVING = 2


@dataclass(frozen=True)
class Motion:
    """A viewer's velocities in his own frame: units of length, and radians, a second."""

    linear: np.ndarray  # (3,)
    angular: np.ndarray  # (3,)


def motion_at(poses: tuple[Pose, ...], frame: int, frames_per_second: float) -> Motion:
    """By the pose now and VELOCITY_S before."""
    before = max(0, frame - max(1, round(VELOCITY_S * frames_per_second)))
    seconds = max(1, frame - before) / frames_per_second
    now, then = poses[frame], poses[before]
    linear = now.rotation @ (now.centre - then.centre) / seconds
    return Motion(linear, _rotation_vector(now.rotation @ then.rotation.T) / seconds)


def ahead(pose: Pose, motion: Motion, seconds: float) -> Pose:
    """The pose at constant velocities."""
    turn = _rotation(motion.angular * seconds)
    return Pose(turn @ pose.rotation, pose.centre + pose.rotation.T @ (motion.linear * seconds))


def shift_px(motion: Motion, screen: Screen, margin_share: float, distance: float) -> tuple[float, float]:
    """By how many pixels the margin goes to each side: clamp((v / v_max + omega / omega_max) / 2, -1, 1) times it."""
    speed = motion.linear / (FULL_SPEED * distance)
    turn = motion.angular / FULL_TURN_RADIANS_S
    x = np.clip(0.5 * (speed[0] - turn[1]), -1, 1) * margin_share * screen.width_px
    y = np.clip(0.5 * (speed[1] + turn[0]), -1, 1) * margin_share * screen.height_px
    return float(x), float(y)


@dataclass(frozen=True)
class Parts:
    """What one frame may ask for, by reason. Each prediction takes some of them."""

    required: Feedback  # the picture's own pages, without ancestors: what can be missing
    visible: Feedback  # the same, with what policy adds to it
    margin: Feedback
    bias: Feedback
    poses: Feedback

    def asked(self, prediction: str) -> Feedback:
        """All that is asked for by one of PREDICTIONS."""
        parts = [self.visible]
        if prediction in ("frustum", "combined"):
            parts += [self.margin, self.poses]
        if prediction in ("bias", "combined"):
            parts.append(self.bias)
        return merged(parts)


def parts_of(
    places: Places, pose: Pose, motion: Motion, screen: Screen, distance: float, turn: int
) -> dict[str, Parts]:
    """What a frame wants, by policy. The picture is drawn once, with the wider margin; one pose ahead once more,
    smaller."""
    widest = max(PUBLISHED_MARGIN, MARGIN_SHARE)
    extra = round(widest * screen.width_px), round(widest * screen.height_px)
    wide = Screen(screen.width_px + 2 * extra[0], screen.height_px + 2 * extra[1], screen.focal_px)
    shift = shift_px(motion, screen, widest, distance)
    seen = places.seen(pose, wide, HALVING, shift)
    inner = seen.inner(_sides(widest, 0.0, shift, screen))
    required = seen.wanted(REQUIRED, where=inner)
    margins = {
        share: seen.wanted(MARGIN, where=seen.inner(_sides(widest, share, shift, screen)) & ~inner)
        for share in (PUBLISHED_MARGIN, MARGIN_SHARE)
    }
    paper = Parts(required, required, margins[PUBLISHED_MARGIN], seen.wanted(BIAS, PUBLISHED_BIAS, inner), EMPTY)
    bias = PUBLISHED_BIAS * float(np.clip(motion.linear[2] / (FULL_SPEED * distance), 0, 1))
    biased = seen.wanted(BIAS, bias, inner) if bias else EMPTY
    poses = places.seen(ahead(pose, motion, AHEAD_S[turn % len(AHEAD_S)]), screen, 2 * HALVING).wanted(POSE)
    parents = places.layout.parents
    ours = (with_ancestors(part, parents) for part in (required, margins[MARGIN_SHARE], biased, poses))
    return {"paper": paper, "default": Parts(required, *ours)}


def _sides(widest: float, share: float, shift: tuple[float, float], screen: Screen) -> tuple[int, int, int, int]:
    """Left, top, right and bottom margins in px that leave of a picture with the `widest` margin the view with a margin
    of `share`; each is shifted by its own share of the shift."""
    inside = 1 - share / widest
    x, y = inside * widest * screen.width_px, inside * widest * screen.height_px
    return (
        round(x - inside * shift[0]),
        round(y - inside * shift[1]),
        round(x + inside * shift[0]),
        round(y + inside * shift[1]),
    )


def _rotation_vector(rotation: np.ndarray) -> np.ndarray:
    angle = np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    length = np.linalg.norm(axis)
    return np.zeros(3) if length < 1e-12 else axis / length * angle


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Rodrigues' formula."""
    angle = np.linalg.norm(vector)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
