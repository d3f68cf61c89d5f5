"""Numbers, quaternions and rigid poses out of the tree of an E57 file, checked.

References: ASTM E2807-11, section 8.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from pye57 import libe57

from pipeline.readers.e57.damage import check_header, reason_of
from storage.errors import InvalidScan

_DAMAGE = (libe57.E57Exception, AttributeError, TypeError, LookupError, ValueError, RuntimeError)


@dataclass(frozen=True)
class Pose:
    """Local to file coordinates: x_file = rotation @ x_local + translation."""

    rotation: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def apply(self, local: np.ndarray) -> np.ndarray:  # (n, 3) float64 to (n, 3)
        return local @ np.array(self.rotation).T + np.array(self.translation)


@contextmanager
def open_image_file(path: str) -> Iterator[libe57.ImageFile]:
    """The opened file; libe57's errors, also those of the body, become InvalidScan.

    So do its C++ exceptions that are not E57's own, and a lookup or a method that fails: a node of another kind than
    the standard asks for lacks them.
    """
    check_header(path)
    try:
        file = libe57.ImageFile(path, "r")
        try:
            yield file
        finally:
            file.close()
    except _DAMAGE as error:
        raise InvalidScan(path, f"unreadable: {reason_of(error)}", "a whole E57 file", "it is damaged") from error


def number(node: libe57.Node) -> float | int:
    """The value of an integer, scaled integer or float node."""
    return node.scaledValue() if isinstance(node, libe57.ScaledIntegerNode) else node.value()


def child_number(parent: libe57.StructureNode, name: str, where: str) -> float:
    """A finite number that must be there."""
    if not parent.isDefined(name):
        raise InvalidScan(f"{where}.{name}", "missing", "a number")
    value = number(parent[name])
    if not np.isfinite(value):
        raise InvalidScan(f"{where}.{name}", f"{value}", "a finite number")
    return value


def rotation_matrix(w: float, x: float, y: float, z: float) -> np.ndarray:  # (3, 3)
    """The rotation of a quaternion of any length but 0."""
    w, x, y, z = np.array([w, x, y, z]) / np.linalg.norm([w, x, y, z])
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def read_pose(node: libe57.StructureNode, where: str) -> Pose | None:
    """The pose of a scan or an image, or None where it has none.

    Raises: InvalidScan for a quaternion of length 0 and for numbers that are not finite.
    """
    if not node.isDefined("pose"):
        return None
    pose, where = node["pose"], f"{where}.pose"
    rotation, translation = np.eye(3), [0.0, 0.0, 0.0]
    if pose.isDefined("rotation"):
        quaternion = [child_number(pose["rotation"], c, f"{where}.rotation") for c in "wxyz"]
        if not any(quaternion):
            raise InvalidScan(f"{where}.rotation", f"{quaternion}", "a quaternion that is not 0")
        rotation = rotation_matrix(*quaternion)
    if pose.isDefined("translation"):
        translation = [float(child_number(pose["translation"], c, f"{where}.translation")) for c in "xyz"]
    return Pose(tuple(tuple(map(float, row)) for row in rotation), tuple(translation))  # type: ignore[arg-type, misc]
