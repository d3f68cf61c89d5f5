"""What storing patches takes of a job: they are written once, and read where they are learned from and coded. A job
without them cannot save more.

    python -m benchmarks.stored_patches SCAN [--preset balanced] [--rounds 3]

Processor seconds of tasks, one after the other in this process, kernels compiled by a first round on few splats: medians
of rounds. `written` is what `resample` takes more where it keeps its texels, `read` what all texels take to be looked at.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.patches import Silent
from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import Settings, settings_for
from pipeline.stages.texture.encode import ROWS
from pipeline.stages.texture.texels import texel_pieces
from services.flow.asked import prepare_asked
from services.flow.code import resample
from services.flow.run import Run
from services.processes.compress import make


def measured(scan: Path, settings: Settings) -> tuple[float, float, float]:
    """Processor seconds of a job with stored patches, and of these what writing and reading them takes."""
    with tempfile.TemporaryDirectory() as name, SerialExecutor() as executor:
        run = Run(Path(name) / "work", executor, Silent())
        prepared = prepare_asked(run, scan, settings)
        again, kept = (resample(run, prepared, kept) for kept in (False, True))
        written = _processor_seconds(kept.folder) - _processor_seconds(again.folder)
        begun = time.process_time()
        for _, texel in texel_pieces(kept.folder, 0, prepared.splats.summary.n_splats, ROWS):
            texel.max()
        read = time.process_time() - begun
        out = Path(name) / "out"
        out.mkdir()
        make(run, scan, settings, out, render=False)
        folders = {summary.parent for summary in (Path(name) / "work").glob("*/summary.json")} - {again.folder}
        return sum(map(_processor_seconds, folders)), written, read


def _processor_seconds(folder: Path) -> float:
    return sum(json.loads(task.read_text())["processor_seconds"] for task in (folder / "results").glob("*.json"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    measured(args.scan, settings_for(args.preset, density=0.03))
    rounds = [measured(args.scan, settings_for(args.preset)) for _ in range(args.rounds)]
    job, written, read = np.median(rounds, axis=0)
    print(
        f"{args.scan.name}, {args.preset}: tasks take {job:.1f} s with stored patches, {written:.2f} of it to write them and "
        f"{read:.2f} to read them: no job without them takes less than {100 * (1 - (written + read) / job):.0f} % of that"
    )


if __name__ == "__main__":
    main()
