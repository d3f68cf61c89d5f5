"""What black and white stand for in the colours of a scan, told from all values that were looked at, not from one of them.

Files say 16 bits and hold 8 or 12, say nothing and hold floats of 0 to 1 or of 0 to 255, and have one value beyond. An
`Evidence` counts values between the tops that occur; `range_of` decides. Every reader asks here.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.execution.compiled import kernel

# A 256 among 8-bit values is white that somebody scaled by 256 / 255; so is 4096 of 12 bits.
_TOPS = np.array([0.0, 1.001, 256.0, 1024.0, 4096.0, 16384.0, 65536.0])
_MULTIPLES = np.union1d(np.arange(256, 1 << 16, 256), np.arange(257, 1 << 16, 257))
FEW = 1024  # values that tell the most frequent one, which matters only where nearly all are alike
STRAYS = 0.005  # the share of values that may lie beyond the range of all others
REACHED = 0.75  # of 10 and 14 bits, which are rare: a dark 16-bit scan is likelier unless the values fill them
ALIKE = 0.999  # the share of points of one value that make a constant
_SCALED = 0.99  # the share of values that are multiples of 256 or 257: 8 bits that were made 16


@dataclass
class Evidence:
    """Counts of the values of an attribute: how many lie up to which top, and whether they differ at all."""

    n_points: int = 0
    n_unknown: int = 0  # points with a value that is not finite
    n_negative: int = 0
    above: np.ndarray = field(default_factory=lambda: np.zeros(len(_TOPS), np.int64))  # values above each of _TOPS
    n_scaled: int = 0  # values that are multiples of 256 or of 257, and not 0: 8 bits that were made 16
    highest: float = 0.0
    first: np.ndarray | None = None  # the most frequent value of FEW of the first piece
    n_as_first: int = 0

    def add(self, values: np.ndarray) -> None:
        """Look at `values` (n, channels) more; points with one that is not finite say nothing."""
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            known = np.isfinite(values).all(axis=1)
            self.n_unknown += int((~known).sum())
            values = values[known]
        if not len(values):
            return
        self.n_points += len(values)
        if self.first is None:
            some = values[:: max(1, len(values) // FEW)]
            self.first = _most_frequent(some)
        values = np.ascontiguousarray(values)
        if values.dtype in (np.uint8, np.uint16):
            counts = np.zeros(1 << 8 * values.itemsize, np.int64)
            self.n_as_first += int(_count_short(values, counts, self.first))
            running = np.cumsum(counts[::-1])[::-1]
            self.above += [running[int(top) + 1] if top < len(counts) - 1 else 0 for top in _TOPS]
            if len(counts) > 256:
                self.n_scaled += int(counts[_MULTIPLES].sum())
            self.highest = max(self.highest, float(np.flatnonzero(counts)[-1]))
            return
        above, scaled, negative, same, highest = _count(values, _TOPS, self.first)
        self.above += above
        self.n_scaled += int(scaled)
        self.n_negative, self.n_as_first = self.n_negative + int(negative), self.n_as_first + int(same)
        self.highest = max(self.highest, float(highest))

    def like(self) -> Evidence:
        """An empty one, in which the same value counts as the most frequent."""
        return Evidence(first=self.first)

    def merge(self, other: Evidence) -> None:
        """Add what another has seen; `first` is its too, or it has seen nothing."""
        self.n_points += other.n_points
        self.n_unknown += other.n_unknown
        self.n_negative += other.n_negative
        self.above = self.above + other.above
        self.n_scaled += other.n_scaled
        self.highest = max(self.highest, other.highest)
        self.first = other.first if self.first is None else self.first
        self.n_as_first += other.n_as_first

    def to_json(self) -> list:
        first = None if self.first is None else self.first.tolist()
        counts = [self.n_points, self.n_unknown, self.n_negative, self.above.tolist(), self.n_scaled]
        return [*counts, self.highest, first, self.n_as_first]

    @staticmethod
    def from_json(data: list) -> Evidence:
        n_points, n_unknown, n_negative, above, n_scaled, highest, first, n_as_first = data
        known = None if first is None else np.array(first, np.float64)
        return Evidence(
            n_points, n_unknown, n_negative, np.array(above, np.int64), n_scaled, highest, known, n_as_first
        )

    @property
    def is_constant(self) -> bool:
        return self.n_points > 0 and self.n_as_first >= ALIKE * self.n_points

    @property
    def is_grey(self) -> bool:
        """Whether the most frequent value is black, white or between."""
        return self.first is not None and float(np.ptp(self.first)) == 0.0

    @property
    def is_zero(self) -> bool:
        return self.above[0] == 0

    def share_above(self, top: float) -> float:
        """Of the values that are not 0, those above `top`, which is one of the tops."""
        return self.above[int(np.searchsorted(_TOPS, top))] / max(1, self.above[0])


def _most_frequent(values: np.ndarray) -> np.ndarray:
    """The row (channels,) float64 that occurs most often among `values` (n, channels); of equally frequent ones the lowest."""
    if values.dtype in (np.uint8, np.uint16) and values.shape[1] <= 3:  # as one number: sorted in a fifth of the time
        key = np.zeros(len(values), np.int64)
        for channel in values.T:
            key = key << 16 | channel
        distinct, counts = np.unique(key, return_counts=True)
        found = int(distinct[counts.argmax()])
        return np.array([found >> 16 * i & 0xFFFF for i in reversed(range(values.shape[1]))], np.float64)
    distinct, counts = np.unique(values, axis=0, return_counts=True)
    return distinct[counts.argmax()].astype(np.float64)


@dataclass(frozen=True)
class Range:
    """The value that stands for white, and why; `usual` where it is what the type of the values says."""

    top: float
    why: str
    usual: bool
    n_beyond: int = 0  # values above it, which are as bright as can be shown


def range_of(evidence: Evidence, is_float: bool, usual_top: float) -> Range:
    """The range of colours, of a type whose own range is 0 to `usual_top`.

    Guarantees: at most STRAYS of the values that are not 0 lie beyond it; multiples of 256 and 257 are 16 bits however
    dark they are.
    """
    if evidence.is_zero:
        return Range(usual_top, "no value above 0", True)
    if not is_float and evidence.n_scaled >= _SCALED * evidence.above[0] and evidence.highest > 256:
        return _range(evidence, 65535.0, usual_top, "16 bits, multiples of 256 or 257")
    if is_float and evidence.share_above(1.001) <= STRAYS:
        return _range(evidence, 1.0, usual_top, "0 to 1")
    if evidence.share_above(256.0) <= STRAYS:
        return _range(evidence, 255.0, usual_top, "8 bits")
    for bits in (10, 12, 14):
        top = float(1 << bits)
        if evidence.share_above(top) <= STRAYS and (bits == 12 or _fills(evidence, top)):
            return _range(evidence, top - 1, usual_top, f"{bits} bits")
    return _range(evidence, 65535.0, usual_top, "16 bits")


def _fills(evidence: Evidence, top: float) -> bool:
    return REACHED * top <= evidence.highest <= top


def _range(evidence: Evidence, top: float, usual_top: float, what: str) -> Range:
    beyond = int(evidence.above[int(np.searchsorted(_TOPS, top, side="left"))])
    values = int(evidence.above[0])
    share = f"{values - beyond:,} of" if beyond else "all"
    why = f"{what}: {share} {values:,} values above 0 are at most {_TOPS[np.searchsorted(_TOPS, top)]:g}"
    return Range(top, f"{why}, the highest is {evidence.highest:g}", top == usual_top, beyond)


def to_8_bits(values: np.ndarray, top: float) -> np.ndarray:  # (..., 3) to uint8
    """Values of 0 to `top` as 0 to 255, those beyond as bright, or as dark, as can be shown; what is not finite is black."""
    if values.dtype == np.uint8 and top == 255:
        return values
    if values.dtype in (np.uint8, np.uint16):
        return _table(float(top), values.dtype.itemsize)[values]
    known = np.nan_to_num(values.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    return np.rint(np.clip(known * (255 / top), 0, 255)).astype(np.uint8)


def _table(top: float, n_bytes: int) -> np.ndarray:
    return np.rint(np.clip(np.arange(1 << 8 * n_bytes) * (255 / top), 0, 255)).astype(np.uint8)


@kernel()
def _count_short(values, counts, first):
    """Adds how often each value occurs to `counts` (65536,); returns how many rows are as `first`."""
    n, channels = values.shape
    same = 0
    for i in range(n):
        alike = True
        for c in range(channels):
            counts[values[i, c]] += 1
            alike = alike and values[i, c] == first[c]
        same += alike
    return same


@kernel()
def _count(values, tops, first):
    """How many values lie above each of `tops`, are multiples, lie below 0; rows as `first`; the highest."""
    n, channels = values.shape
    above = np.zeros(len(tops), np.int64)
    scaled, negative, same = 0, 0, 0
    highest = 0.0
    for i in range(n):
        alike = True
        for c in range(channels):
            value = float(values[i, c])
            alike = alike and value == first[c]
            if value < -0.002:  # half a level of floats of 0 to 1: less is rounding
                negative += 1
            if value <= 0:
                continue
            highest = max(highest, value)
            whole = np.int64(min(value, 1e9))
            if whole == value and (whole % 257 == 0 or whole % 256 == 0):
                scaled += 1
            for t in range(len(tops)):
                if value <= tops[t]:
                    break
                above[t] += 1
        same += alike
    return above, scaled, negative, same, highest
