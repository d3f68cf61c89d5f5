"""A budget of bytes: the search for its multiplier, and files that keep it."""

from __future__ import annotations

import math

import pytest

from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import settings_for
from services.cli.main import main
from services.flow.budget import LEAST, MOST_TRIALS, NO_ATOMS, Trial, within_budget
from services.processes.compress import compress
from storage.errors import InvalidScan
from tests.pipeline.execution.test_stage import Heard
from tests.services.scans import photo_scan, point_scan

N, BARE = 1000, 5000.0


class Scan:
    """Bytes of a made-up scan at a multiplier: a power of it, up to what 8 atoms take."""

    def __init__(self, exponent: float = -0.5, most: float = 20_000.0) -> None:
        self.multipliers, self.exponent, self.most = [], exponent, most

    def __call__(self, multiplier: float) -> Trial:
        self.multipliers.append(multiplier)
        of_atoms = 0.0 if multiplier == NO_ATOMS else min(self.most, 3000.0 * multiplier**self.exponent)
        return Trial(multiplier, BARE + of_atoms, multiplier)


@pytest.mark.parametrize("budget", [6.0, 8.0, 12.0, 20.0])
@pytest.mark.parametrize("exponent", [-0.3, -0.5, -0.8])
@pytest.mark.parametrize("first", [0.1, 1.0, 10.0])
def test_budget__is_kept_and_used(budget, exponent, first):
    scan = Scan(exponent)
    found = within_budget(budget, N, first, scan)
    assert LEAST * budget * N <= found.n_bytes <= budget * N
    assert len(scan.multipliers) <= 1 + MOST_TRIALS


def test_budget__ends_where_splats_take_no_more():
    scan = Scan(most=1000.0)
    assert within_budget(50.0, N, 1.0, scan).n_bytes == BARE + 1000.0 and len(scan.multipliers) <= 1 + MOST_TRIALS


def test_budget__is_kept_where_splats_begin_with_all_the_atoms_they_may_have():
    scan = Scan(most=2400.0)
    found = within_budget(7.2, N, 0.02, scan)
    assert LEAST * 7.2 * N <= found.n_bytes <= 7.2 * N and len(scan.multipliers) <= 1 + MOST_TRIALS


def test_budget__below_what_a_file_without_atoms_takes_is_refused():
    scan = Scan()
    with pytest.raises(InvalidScan, match="4.5 bytes a splat, of which .* alone take 5.00; allowed: 5.00 and more"):
        within_budget(4.5, N, 1.0, scan)
    assert scan.multipliers == [NO_ATOMS]


def test_budget__no_room_for_atoms_leaves_none():
    assert within_budget(5.01, N, 1.0, Scan()).multiplier == math.inf


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return photo_scan(tmp_path_factory.mktemp("scan") / "wavy plane", n_side=60)


@pytest.mark.parametrize("budget", [15.5, 17.0])
def test_budget__files_keep_it(scan, tmp_path, budget):
    settings = settings_for("draft", budget_bytes=budget, training_splats=2000, iterations=1)
    report = compress(scan, tmp_path / "out", settings, SerialExecutor(), Heard(), render=False)
    assert LEAST * budget <= report["sizes"]["bytes_per_splat"] <= budget


def test_budget__a_scan_whose_geometry_exceeds_it_is_refused(scan, tmp_path, capsys):
    ball = point_scan(tmp_path / "ball.ply")
    for path in (scan, ball):
        assert (
            main(
                [
                    "compress",
                    str(path),
                    "--out",
                    str(tmp_path / "out"),
                    "--executor",
                    "serial",
                    "--no-render",
                    "--budget-bytes",
                    "5",
                ]
            )
            == 3
        )
        assert "--budget-bytes: 5 bytes a splat, of which geometry" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_budget__the_published_coder_has_no_multiplier():
    with pytest.raises(ValueError, match="budget_bytes is 10 with coder paper"):
        settings_for(coder="paper", budget_bytes=10)
