"""How far a job is, by the shares of its stages."""

from __future__ import annotations

from pipeline.catalogue import ALWAYS, BY_NAME, SHARES, common_share
from pipeline.stages.texture.dictionary import KsvdUpdate
from pipeline.stages.texture.quantise import Quantisation

UNKNOWN = 1.0  # share of what the catalogue does not have


class Portion:
    """What is done of a job of `n_rounds` rounds (the points of a trade-off; one of other jobs), 0 to 1.

    Guarantees: never goes back, and stays below 1 until all rounds are through. A stage that not every job has counts
    from when it is first heard of; iterations of k-SVD that were not called for count as done.
    """

    def __init__(self, iterations: int, textured: bool) -> None:
        self._iterations, self._textured = max(1, iterations), textured
        self._highest = 0.0
        self.round(0, 1)

    def round(self, index: int, n_rounds: int) -> None:
        """Round `index` of `n_rounds` begins."""
        self._index, self._n_rounds = index, n_rounds
        self._done, self._n_passes = 0.0, 0
        self._expected = common_share(self._textured)
        self._heard: set[str] = set()

    def passed(self, name: str) -> None:
        """A stage is done."""
        self._hear(name)
        self._done += self._share(name)
        if name == KsvdUpdate.name:
            self._n_passes += 1
        if name == Quantisation.name and self._n_passes:
            self._done += SHARES[KsvdUpdate.name] * max(0.0, 1 - self._n_passes / self._iterations)

    def at(self, name: str, share_done: float) -> float:
        """How far the job is while `share_done` (0 to 1) of the stage `name` is done."""
        self._hear(name)
        done = self._done + self._share(name) * min(1.0, share_done)
        self._highest = max(self._highest, (self._index + min(0.99, done / self._expected)) / self._n_rounds)
        return self._highest

    def _hear(self, name: str) -> None:
        if name and name not in self._heard:
            self._heard.add(name)
            common = name in ALWAYS or (self._textured and name in BY_NAME and BY_NAME[name].when == "photographs")
            self._expected += 0.0 if common else SHARES.get(name, UNKNOWN)

    def _share(self, name: str) -> float:
        if not name:
            return 0.0
        return SHARES.get(name, UNKNOWN) / (self._iterations if name == KsvdUpdate.name else 1)
