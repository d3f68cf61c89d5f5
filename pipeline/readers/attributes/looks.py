"""What has been seen of a scan: evidence of its colours and intensities, and how many points bear which mark.

Looks of pieces are added up, in one process or several, so that what a sample said can be checked against all points.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field

import numpy as np

from pipeline.readers.attributes.marks import MARKS, NUMBER
from pipeline.readers.attributes.ranges import Evidence


@dataclass
class Look:
    """What has been seen of a scan so far."""

    color: Evidence = field(default_factory=Evidence)
    intensity: Evidence = field(default_factory=Evidence)
    n_points: int = 0
    marked: np.ndarray = field(default_factory=lambda: np.zeros(len(MARKS) + 1, np.int64))

    def add(self, n: int, color: np.ndarray | None, intensity: np.ndarray | None, masks: dict[str, np.ndarray]) -> None:
        self.n_points += n
        if color is not None:
            self.color.add(color)
        if intensity is not None:
            self.intensity.add(intensity[:, None])
        for name, mask in masks.items():
            self.marked[NUMBER[name]] += int(np.count_nonzero(mask))

    def like(self) -> Look:
        """An empty one, in which the same values count as alike."""
        return Look(self.color.like(), self.intensity.like())

    def merge(self, other: Look) -> None:
        self.color.merge(other.color)
        self.intensity.merge(other.intensity)
        self.n_points += other.n_points
        self.marked += other.marked

    def to_json(self) -> list:
        return [self.color.to_json(), self.intensity.to_json(), self.n_points, self.marked.tolist()]

    @staticmethod
    def from_json(data: list) -> Look:
        color, intensity = map(Evidence.from_json, data[:2])
        return Look(color, intensity, data[2], np.array(data[3], np.int64))


@dataclass
class Looks:
    """What has been seen of each part of a scan: a station of an E57 file, or the whole."""

    parts: dict[int, Look] = field(default_factory=dict)

    def add(self, look: tuple[int, Look] | None) -> None:
        """What a piece says."""
        if look is not None:
            part, seen = look
            if part in self.parts:
                self.parts[part].merge(seen)
            else:
                self.parts[part] = Look.from_json(seen.to_json())

    def merge(self, other: Looks) -> None:
        for part in other.parts.items():
            self.add(part)

    def to_text(self) -> str:
        """ "" where nothing has been seen."""
        plain = {str(part): look.to_json() for part, look in sorted(self.parts.items())}
        return json.dumps(plain, sort_keys=True) if plain else ""

    @staticmethod
    def from_text(text: str) -> Looks:
        return Looks({int(part): Look.from_json(data) for part, data in json.loads(text or "{}").items()})
