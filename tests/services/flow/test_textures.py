"""The default coder against the published one, on a scan made of photographs of a wavy plane."""

import numpy as np
import pytest

from pipeline.effects.plan.request import parse_request
from pipeline.effects.shipped_dictionary import own_bytes_a_splat
from pipeline.execution.executors import SerialExecutor
from pipeline.planning.dictionary_size import affordable_size
from pipeline.planning.settings import settings_for
from renderer.report.report_words import summary
from services.processes.compress import compress
from storage.packed.dictionaries.shipped import ATOM_BYTES, N_ATOMS, NEWEST
from storage.packed.packed import PackedFile
from tests.pipeline.execution.test_stage import Heard
from tests.services.scans import photo_scan

WANTED = {"dictionary": "own", "training_splats": 4000, "iterations": 2, "effects": "all=off"}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> dict[str, dict]:
    """By name the report of a job, with its header and weight levels."""
    folder = tmp_path_factory.mktemp("coders")
    scan = photo_scan(folder / "wavy plane", n_side=70)
    jobs = {
        "paper": {"coder": "paper", "dictionary_bits": 8, "target_psnr_db": 30.0},
        "default": {"target_psnr_db": 33.0},
        "lower": {"target_psnr_db": 31.0},
        "shipped": {"target_psnr_db": 33.0, "dictionary": "auto", "effects": "all=off,shipped_dictionary=auto"},
        "large": {"target_psnr_db": 32.0, "atom_size": 32, "dictionary_bits": 8},
    }
    reports = {}
    for name, changes in jobs.items():
        settings = settings_for("draft", **(WANTED | changes))
        reports[name] = compress(
            scan, folder / name, settings, SerialExecutor(), Heard(), render=False, work=folder / "work"
        )
        with PackedFile(folder / name / "wavy plane.splatpress") as packed:
            reports[name] |= {"header": packed.header, "levels": packed.read("weight_levels")}
    return reports


def texture_bytes(report: dict) -> int:
    return sum(report["sizes"][part] for part in ("codes_bytes", "colors_bytes", "dictionary_bytes"))


def test_coders__the_papers_has_whole_atoms_and_even_weights(made):
    header, levels = made["paper"]["header"], made["paper"]["levels"]
    assert (header.atom_size, header.n_turns, header.dictionary_bits) == (32, 1, 8)
    assert (levels == levels[0]).all()
    np.testing.assert_allclose(np.diff(levels[0]), levels[0, 1] - levels[0, 0], rtol=1e-4)


def test_coders__weight_levels_are_those_of_weights_that_pay_at_the_multiplier(made):
    """A weight below the root of the multiplier lowers the error by less than an atom must: such levels are lost."""
    least = {name: np.abs(made[name]["levels"][0]).min() for name in ("default", "lower")}
    assert least["lower"] > 1.1 * least["default"]  # 2 dB are a factor of 1.26


def test_coders__the_default_has_more_quality_for_fewer_bytes(made):
    paper, default = made["paper"], made["default"]
    assert texture_bytes(default) < 0.6 * texture_bytes(paper)
    assert default["quality"]["texture_psnr_db"] > paper["quality"]["texture_psnr_db"] + 0.5
    assert default["quality"]["visible_psnr_db"] > paper["quality"]["visible_psnr_db"] + 0.5


@pytest.mark.parametrize(("name", "target_psnr_db"), [("default", 33.0), ("lower", 31.0), ("large", 32.0)])
def test_coders__the_default_meets_its_target_on_the_whole(made, name, target_psnr_db):
    assert target_psnr_db - 0.3 < made[name]["quality"]["texture_psnr_db"] < target_psnr_db + 2


def test_coders__the_default_takes_small_atoms_in_turns_where_they_show_the_target(made):
    header = made["default"]["header"]
    assert header.n_turns == 8 and header.atom_size < 32
    assert 8 * header.n_dictionary <= 2**header.dictionary_bits < 16 * header.n_dictionary
    assert made["large"]["header"].atom_size == 32


def test_coders__a_lower_target_costs_less(made):
    assert texture_bytes(made["lower"]) < texture_bytes(made["default"])
    assert made["lower"]["atoms"]["mean"] < made["default"]["atoms"]["mean"]


def test_coders__atoms_are_no_larger_than_splats_pay_for_them():
    """A dictionary of 32 atoms with its mip levels is 8, 33 or 131 kB."""
    sizes = {n: affordable_size(n) for n in (1, 4_000, 16_383, 16_384, 65_535, 65_536)}
    assert sizes == {1: 8, 4_000: 8, 16_383: 8, 16_384: 16, 65_535: 16, 65_536: 32}
    assert [affordable_size(n, 12) for n in (60_000, 109_000, 330_000)] == [8, 16, 32], (
        "of 512 it is sixteen times that"
    )


def test_coders__few_splats_take_the_atoms_that_ship_and_learn_none(made):
    own, report = made["default"], made["shipped"]
    assert report["header"].shipped == NEWEST and not own["header"].shipped
    learning = {"dictionary-seed", "ksvd-update"}
    assert not report["learning"] and not learning & {stage["name"] for stage in report["stages"]}
    row = next(row for row in report["effects"] if row["effect"] == "shipped_dictionary")
    assert row["enabled"] and row["measure"] == own_bytes_a_splat(report["splats"]) >= row["threshold"]
    assert report["sizes"]["shipped_bytes"] >= N_ATOMS * ATOM_BYTES and own["sizes"]["shipped_bytes"] == 0
    assert report["quality"]["texture_psnr_db"] > 32.9, "what was asked for"
    sizes = report["sizes"]
    n_own = sizes["gpu_bytes"] - sizes["shipped_bytes"]
    assert sizes["own_bytes_per_splat"] == n_own / report["splats"] < sizes["bytes_per_splat"]
    assert sizes["own_factor_total"] == pytest.approx(sizes["compression_factor_total"] * sizes["gpu_bytes"] / n_own)
    assert sizes["own_factor_texture"] == sizes["source_texture_bytes"] / (n_own - sizes["geometry_bytes"])
    for name in ("bytes_per_splat", "factor_total", "factor_texture"):
        assert own["sizes"][f"own_{name}"] == own["sizes"][name if name in own["sizes"] else f"compression_{name}"]
    assert "atoms that ship with the program, as many for any scan" in summary(report)
    assert "atoms" not in summary(own)


def test_coders__what_asks_for_other_atoms_learns_its_own():
    asked = {
        name: parse_request(settings_for(**changes).asked_effects)["shipped_dictionary"]
        for name, changes in {
            "auto": {},
            "high": {"preset": "high"},
            "paper": {"coder": "paper"},
            "texels": {"atom_size": 8},
            "bits": {"dictionary_bits": 10},
            "budget": {"budget_bytes": 12.0},
            "own": {"dictionary": "own", "effects": "shipped_dictionary=on"},
            "shipped": {"dictionary": "shipped", "effects": "all=off"},
        }.items()
    }
    assert asked == {"auto": "auto", "high": "auto", "shipped": "on"} | dict.fromkeys(
        ("paper", "texels", "bits", "budget", "own"), "off"
    )
    with pytest.raises(ValueError, match="dictionary is shipped with coder paper"):
        settings_for(dictionary="shipped", coder="paper")
