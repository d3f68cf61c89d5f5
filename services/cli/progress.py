"""Progress on stderr: stage, share done, splats a second, time left."""

from __future__ import annotations

import sys
import time

from tqdm import tqdm

from pipeline.execution.stage import StageRecord

FORMAT = "{desc:<16} {percentage:3.0f}% |{bar:24}| {postfix} {elapsed} gone, {remaining} left"


class ProgressBars:
    """A bar a stage, one below the other; where stderr is no terminal, a line a finished stage."""

    def __init__(self) -> None:
        self._bar: tqdm | None = None
        self._begun, self._n_splats = 0.0, 0

    def begin(self, name: str, n_tasks: int) -> None:
        self._close()
        self._begun, self._n_splats = time.perf_counter(), 0
        self._bar = tqdm(
            total=n_tasks, desc=name, bar_format=FORMAT, file=sys.stderr, leave=False, disable=not sys.stderr.isatty()
        )

    def advance(self, name: str, n_tasks: int, n_splats: int) -> None:
        self._n_splats += n_splats
        seconds = time.perf_counter() - self._begun
        if self._n_splats and seconds > 0:
            self._bar.set_postfix_str(f"{self._n_splats / seconds:,.0f} splats/s", refresh=False)
        self._bar.update(n_tasks)

    def end(self, record: StageRecord) -> None:
        self._close()
        rate = f", {record.n_splats / record.seconds:,.0f} splats/s" if record.n_splats and record.seconds > 0 else ""
        how = "reused" if record.reused else f"{record.seconds:.1f} s{rate}"
        print(f"{record.name:<16} {how}", file=sys.stderr)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
