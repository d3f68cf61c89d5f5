"""What effects are worth on a scan, measured; and what the service knows of a scan that a job has measured."""

import json

import pytest

from pipeline.effects.plan.measure_effects import known_rows
from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import settings_for
from renderer.evaluate.variants import EffectsVariant, compare_variants
from services.processes.compress import compress
from services.processes.effects import effects_of, worth_of_effects
from tests.effects_scans import step_scan, wall_scan
from tests.services.processes.test_compress import Heard

SETTINGS = settings_for("draft", max_atoms=0)


@pytest.fixture(scope="module")
def measured(tmp_path_factory, renderer) -> dict:
    folder = tmp_path_factory.mktemp("step")
    return worth_of_effects(
        step_scan(folder / "step", n_side=61), SETTINGS, SerialExecutor(), Heard(), folder / "work", folder / "out"
    ) | {"out": folder / "out"}


def test_effects__measure_has_the_plan_all_on_and_each_alone_off(measured):
    on = [row["effect"] for row in measured["rows"] if row["enabled"]]
    assert "cliplines" in on
    assert [v["variant"] for v in measured["variants"]] == ["plan", "all on", "all off", *(f"without {e}" for e in on)]
    for v in measured["variants"]:
        assert (
            v["frame_s"] > 0
            and v["frame_ratio"] > 0
            and v["gpu_bytes"] > 0
            and v["file_bytes"] > 0
            and v["psnr_vs_photos_db"] > 10
        )
    found = json.loads((measured["out"] / "effects.json").read_text())
    assert found["variants"] == json.loads(json.dumps(measured["variants"], allow_nan=False))
    pictures = {path.name for path in measured["out"].glob("*.png")}
    assert pictures == {"all_on.png", "all_off.png", *(f"without_{e}.png" for e in on)}


def test_effects__off_takes_its_bytes_and_its_shader_code_along(measured):
    variants = {v["variant"]: v for v in measured["variants"]}
    plan, without, all_on = variants["plan"], variants["without cliplines"], variants["all on"]
    assert any("clipline" in name for name in plan["programs"]) and not any(
        "clipline" in name for name in without["programs"]
    )
    assert without["gpu_bytes"] < plan["gpu_bytes"] <= all_on["gpu_bytes"]
    assert any("lit" in name.split() for name in all_on["programs"]) and not any(
        "lit" in name.split() for name in plan["programs"]
    )


def test_effects__a_wall_has_an_empty_plan_and_equals_the_all_on_rendering(tmp_path, renderer):
    scan, work = wall_scan(tmp_path / "wall", n_side=61), tmp_path / "work"
    made = {
        name: compress(
            scan,
            tmp_path / name,
            settings_for("draft", max_atoms=0, effects=request),
            SerialExecutor(),
            Heard(),
            render=False,
            work=work,
        )
        for name, request in (("plan", ""), ("plain", "all=off"), ("all-on", "all=on"))
    }
    assert not any(row["enabled"] for row in made["plan"]["effects"])
    page = (tmp_path / "plan" / "report.html").read_text()
    assert all(f"<td>{row['effect'].replace('_', ' ')}<small>" in page for row in made["plan"]["effects"])
    photos = next(work.glob("ingest-*"))
    plan, plain, all_on = compare_variants(
        [EffectsVariant(name, tmp_path / name / "wall.splatpress", photos) for name in made]
    )
    assert plan["gpu_bytes"] == plain["gpu_bytes"]
    unwatched = [name.removesuffix(" watched") for name in plan["programs"]]  # which all=off gives up, a plan does not
    assert unwatched == plain["programs"]
    assert plan["file_bytes"] == pytest.approx(plain["file_bytes"], rel=0.02)
    assert plain["psnr_vs_first_db"] == 100
    assert all_on["psnr_vs_first_db"] >= 50  # its splats are larger by up to a sixteenth of an octave
    assert plan["gpu_bytes"] <= all_on["gpu_bytes"]


def test_effects__a_work_folder_knows_the_last_plan(tmp_path):
    assert known_rows(tmp_path) is None
    settings = settings_for("draft")  # which ask nothing of effects
    rows = effects_of(wall_scan(tmp_path / "wall", n_side=41), settings, SerialExecutor(), Heard(), tmp_path / "work")
    assert known_rows(tmp_path / "work") == rows
