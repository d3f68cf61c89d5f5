"""What the scan says of each effect, measured on some of its blocks before anything is computed for any of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.effects.block import Sources
from pipeline.effects.effect import Measured
from pipeline.effects.plan.plan import plan_effects
from pipeline.effects.plan.registry import effects
from storage.work import arrays, work

MOST_BLOCKS = 16  # 262,144 splats, evenly among all: a share of 1 % is then known to a hundredth of itself


@dataclass(frozen=True)
class BlockMeasured:
    """What a task tells of its block: what each effect has summed over it, in the effect's own words."""

    n_splats: int
    sums: dict[str, dict]


@dataclass(frozen=True)
class MeasureEffects:
    """A task a block, of at most MOST_BLOCKS blocks. The summary has a `Measured` by effect."""

    sources: Sources
    names: tuple[str, ...]  # of the effects that are left to measure
    surveys: tuple[tuple[str, Path], ...] = ()
    name = "measure-effects"
    most_splats = MOST_BLOCKS * arrays.BLOCK

    def init(self, folder: Path) -> int:
        return min(MOST_BLOCKS, len(self._blocks()))

    def run(self, folder: Path, index: int) -> BlockMeasured:
        blocks = self._blocks()
        chosen = index * len(blocks) // min(MOST_BLOCKS, len(blocks))
        block = self.sources.block(blocks[chosen], dict(self.surveys))
        start, stop = block.rows
        return BlockMeasured(
            n_splats=stop - start, sums={name: effects()[name].measure_block(block) for name in self.names}
        )

    def _blocks(self) -> range:
        """Those of the finest level; the first may begin with a group of a coarser one."""
        return range(self.sources.first_finest // arrays.BLOCK, arrays.n_blocks(self.sources.n_splats))

    def finalise(self, folder: Path, results: list[BlockMeasured]) -> dict[str, Measured]:
        return {name: effects()[name].conclude([r.sums[name] for r in results], self.sources) for name in self.names}


def known_rows(work_folder: Path) -> list[dict] | None:
    """The rows of the plan that the scan of a work folder makes by itself, as it was measured last; None if it never
    was."""
    last = work.last_complete(work_folder, MeasureEffects.name)
    if last is None:
        return None
    n_splats = sum(task.n_splats for task in work.finished_tasks(last).values())
    return plan_effects(work.summary(last, dict[str, Measured]), {}, n_splats).to_json()
