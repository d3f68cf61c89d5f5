"""The ladder of what accuracy costs: what it tries, what it uses again, and what its page says."""

from __future__ import annotations

import pytest
from msgspec import structs

from pipeline.execution.executors import SerialExecutor
from pipeline.numerics.accuracy import BEST_DB
from pipeline.planning.knobs import BY_NAME
from pipeline.planning.settings import PRESETS, settings_for
from renderer.report.tradeoff_document import Advice, Beaten, LadderPoint
from renderer.report.tradeoff_page import WANTED_DB, advised, leading, pareto, summarised
from services.cli.main import main
from services.flow.code import code
from services.flow.prepare import prepare
from services.flow.run import Run
from services.processes.compress import compress
from services.processes.tradeoff import default_knobs, ladder, measure_ladder, parsed_budget, parsed_knobs, tradeoff
from storage.errors import InvalidScan
from tests.pipeline.execution.test_stage import Heard
from tests.renderer.report.test_report import Elements
from tests.services.processes.published_schemas import misfits
from tests.services.scans import photo_scan, point_scan

SETTINGS = settings_for("draft", dictionary="own", target_psnr_db=28.0, training_splats=600, iterations=2)


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return photo_scan(tmp_path_factory.mktemp("scan") / "wavy plane", n_side=32)


@pytest.fixture(scope="module")
def made(scan, tmp_path_factory, renderer):
    out = tmp_path_factory.mktemp("ladder") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("services.processes.tradeoff.PRESETS", {"draft": PRESETS["draft"]})
        document = tradeoff(
            scan, out, SETTINGS, SerialExecutor(), Heard(), knobs={"target_psnr_db": (26.0,), "max_atoms": (2,)}
        )
    return out, document, {point.key: point for point in document.points}


# --- the ladder


def test_ladder__takes_the_chosen_settings_then_presets_then_knobs_in_turns():
    steps = ladder(settings_for("balanced"), {"iterations": (1, 3), "weight_bits": (8,)})
    assert [s.key for s in steps] == [
        "chosen",
        "draft",
        "high",
        "archive",
        "iterations=1",
        "weight_bits=8",
        "iterations=3",
    ]
    assert (
        steps[0].preset == "balanced"
        and steps[4].knob == "iterations"
        and steps[4].settings == settings_for("balanced", iterations=1)
    )


def test_ladder__measures_nothing_twice():
    steps = ladder(
        settings_for("balanced"), {"iterations": (settings_for("balanced").iterations, 3, 3), "weight_bits": (4,)}
    )
    assert [s.key for s in steps][4:] == ["iterations=3"]


def test_ladder__every_step_says_the_arguments_that_ask_for_it():
    assert ladder(settings_for("draft", target_psnr_db=41.5), {})[0].command == "--preset draft --target-psnr-db 41.5"
    assert ladder(settings_for("high"), {})[0].command == "--preset high"


def test_ladder__presets_are_of_the_same_splats_of_the_same_scan():
    steps = ladder(settings_for("draft", density=0.1, sparse_model="sparse/1", budget_bytes=9.0), {})
    assert [s.key for s in steps] == ["chosen", *PRESETS]
    assert all((s.settings.density, s.settings.sparse_model) == (0.1, "sparse/1") for s in steps)
    assert [s.settings.budget_bytes for s in steps] == [9.0, None, None, None, None]
    assert steps[2].command == "--preset balanced --density 0.1 --sparse-model sparse/1"


def test_ladder__the_usual_knobs_are_allowed_values():
    for name, values in default_knobs().items():
        assert all(settings_for(**{name: value}) for value in values)
    assert {"target_psnr_db", "max_atoms", "iterations"} <= default_knobs().keys()


@pytest.mark.parametrize(("text", "seconds"), [("90s", 90), ("10min", 600), ("2h", 7200), ("0.5h", 1800), ("45", 45)])
def test_budget__is_a_time(text, seconds):
    assert parsed_budget(text) == seconds


@pytest.mark.parametrize("text", ["", "0s", "-1min", "soon", "infh", "nan", "10 parsecs"])
def test_budget__that_is_no_time_is_refused(text):
    with pytest.raises(ValueError, match="allowed: a time above 0"):
        parsed_budget(text)


def test_knobs__are_parsed_and_refused_by_the_table():
    assert parsed_knobs(["iterations=1,3", "target_psnr_db=40"]) == {"iterations": (1, 3), "target_psnr_db": (40.0,)}
    for text in ("speed=1", "iterations", "iterations=0", "weight_bits=4,7"):
        with pytest.raises(ValueError):
            parsed_knobs([text])


# --- fronts and advice


def point(key, n_bytes, psnr, seconds=1.0, preset=None, splats=100, picture=None):
    sizes = {"gpu_bytes": n_bytes, "file_bytes": n_bytes, "bytes_per_splat": n_bytes / splats, "peak_memory_bytes": 1}
    clocks = {"seconds": seconds, "run_seconds": seconds}
    psnrs = {"texture_psnr_db": psnr, "visible_psnr_db": psnr, "picture_psnr_db": picture}
    of_coder = {"mean_atoms": 1.0, "n_dictionary": 1, "reused": (), "settings": {}, "n_cameras": 1}
    return LadderPoint(key, preset, None, None, "", splats, **sizes, **clocks, **psnrs, **of_coder)


POINTS = [
    point("a", 10, 38.0, 5, "draft"),
    point("b", 12, 41.0, 9, "balanced"),
    point("c", 11, 40.5, 8),
    point("d", 13, 40.0, 20, "high"),
]


def test_pareto__holds_what_nothing_beats_and_only_that():
    assert pareto(POINTS, "file_bytes") == ["a", "c", "b"] == pareto(POINTS, "seconds")
    assert pareto([point("x", 1, 30), point("y", 1, 31)], "file_bytes") == ["y"]


def test_advised__names_the_preset_and_the_point_of_fewest_bytes():
    assert advised(POINTS, 40.0) == Advice(40.0, "b", "c")
    assert advised(POINTS, 42.0) is None and advised(POINTS, 38.0).preset == "a"


@pytest.mark.parametrize(
    ("reached", "said"),
    [
        (WANTED_DB, [40.0, 42.0]),
        (WANTED_DB[:-3], [40.0]),
        ((30.0, 32.0, 34.0), [32.0, 34.0]),
        ((34.0,), [34.0]),
        ((), []),
    ],
)
def test_leading__is_one_per_cent_of_error_and_the_step_after_it_or_the_best_that_there_is(reached, said):
    assert [row["wanted_db"] for row in leading([{"wanted_db": db} for db in reached])] == said


def test_summarised__tells_which_presets_another_beats():
    assert summarised(POINTS).beaten_presets == (Beaten("high", "balanced"),)


def test_summarised__fewer_splats_are_compared_by_pictures_alone():
    points = [
        point("chosen", 10, 40.0, picture=27.0),
        point(
            "density=0.1", 3, 44.0, splats=10, picture=21.0
        ),  # more bytes a splat, and sharper textures of larger splats
        point("density=0.5", 11, 42.0, splats=50, picture=24.0),  # more bytes for less
    ]
    found = summarised(points)
    assert found.fronts["file_bytes"] == ("density=0.1", "chosen")
    assert {row.cheapest for row in found.advice} == {"chosen"}
    unseen = summarised([structs.replace(p, picture_psnr_db=None) for p in points])
    assert unseen.fronts["file_bytes"] == ("chosen",)


# --- a whole one


def test_tradeoff__measures_what_compress_makes(made, scan, tmp_path):
    report = compress(
        scan,
        tmp_path / "out",
        settings_for("draft", dictionary="own", target_psnr_db=26.0, training_splats=600, iterations=2),
        SerialExecutor(),
        Heard(),
        render=False,
    )
    found = made[2]["target_psnr_db=26.0"]
    assert (found.texture_psnr_db, found.gpu_bytes, found.file_bytes) == pytest.approx(
        (report["quality"]["texture_psnr_db"], report["sizes"]["gpu_bytes"], report["sizes"]["file_bytes"]), rel=2e-3
    )


def test_tradeoff__uses_again_what_a_change_does_not_touch_and_counts_it_all_the_same(made):
    chosen, fewer = made[2]["chosen"], made[2]["max_atoms=2"]
    assert not chosen.reused and {"ingest", "resample", "training-set"} <= set(fewer.reused)
    assert fewer.seconds > fewer.run_seconds and fewer.mean_atoms <= 2 < chosen.mean_atoms


def test_tradeoff__leaves_the_document_the_page_and_its_pictures(made):
    out, document, points = made
    assert misfits(out / "tradeoff.json") == []
    assert sorted(p.name for p in out.iterdir()) == ["close-ups", "tradeoff.html", "tradeoff.json"]
    assert all(10 < p.picture_psnr_db < 60 for p in points.values()) and document.fronts["file_bytes"]
    assert all(p.frame_seconds > 0 for p in points.values()) and len(document.close_ups) == 3
    assert all(set(row.pictures) == {"photographs", *points} for row in document.close_ups)


def test_tradeoff__the_page_has_a_panel_for_every_point_and_asks_no_other_host(made):
    elements = Elements((made[0] / "tradeoff.html").read_text())
    asked = [
        v for _, a in elements.tags for k, v in a.items() if k in ("src", "href") and not v.startswith(("data:", "#"))
    ]
    assert not asked and not {tag for tag, _ in elements.tags} & {"link", "iframe", "base"}
    panels = [a["id"] for tag, a in elements.tags if tag == "div" and "point" in (a.get("class") or "").split()]
    assert panels == [f"point-{i}" for i in range(1, 1 + len(made[2]))]
    assert not {"nan", "None", "inf"} & set("".join(elements.text).split())


def test_ladder__tries_the_next_decibels_first():
    steps = ladder(settings_for("balanced"), default_knobs())
    assert steps[len(PRESETS)].key == "target_psnr_db=42.0"


def test_tradeoff__a_budget_ends_the_ladder_after_its_first_point(scan, tmp_path):
    document = tradeoff(
        scan, tmp_path / "out", SETTINGS, SerialExecutor(), Heard(), knobs={}, budget_s=1e-3, render=False
    )
    assert [p.key for p in document.points] == ["chosen"] and [s.key for s in document.skipped] == list(PRESETS)
    assert "The budget of" in (tmp_path / "out" / "tradeoff.html").read_text()


def test_tradeoff__what_points_share_is_not_expected_of_the_next_one(scan, tmp_path):
    """The first point took 100 s of the budget's 160, nearly all for splats and patches, which the next one reuses."""
    (tmp_path / "out").mkdir()
    times = iter([0.0, 100.0])
    run = Run(tmp_path / "work", SerialExecutor(), Heard(), clock=lambda: next(times, 1000.0))
    document = measure_ladder(run, scan, tmp_path / "out", SETTINGS, {"max_atoms": (1, 2)}, 160.0, render=False)
    assert [p.key for p in document.points] == ["chosen", "draft"] and len(document.skipped) == len(PRESETS) + 1


def test_tradeoff__a_scan_without_photographs_is_compared_with_all_of_its_points_or_refused(tmp_path, renderer):
    ball, settings = point_scan(tmp_path / "ball.ply"), settings_for("draft", density=0.5)
    with pytest.raises(InvalidScan, match="allowed: a scan with photographs"):
        tradeoff(ball, tmp_path / "out", settings, SerialExecutor(), Heard(), render=False)
    assert [p.name for p in tmp_path.iterdir()] == ["ball.ply"]
    knobs = {"density": (0.25,), "iterations": (1, 3), "levels": (0,)}
    found = tradeoff(ball, tmp_path / "out", settings, SerialExecutor(), Heard(), knobs=knobs)
    points = {p.key: p for p in found.points}
    assert list(points) == [
        "chosen",
        "density=1.0",
        "density=0.25",
        "levels=0",
    ]  # no preset, no passes: nothing is learned
    assert [p.same_as for p in found.points] == [None, None, None, "chosen"]
    assert "changes nothing here: the splats of chosen" in (tmp_path / "out" / "tradeoff.html").read_text()
    assert points["density=1.0"].picture_psnr_db == BEST_DB and not found.advice
    assert points["density=0.25"].picture_psnr_db < points["chosen"].picture_psnr_db < 60
    assert list(found.fronts["file_bytes"]) == [
        "density=0.25",
        "levels=0",
        "density=1.0",
    ]  # a header shorter than the chosen
    assert not {"nan", "None", "inf"} & set(
        "".join(Elements((tmp_path / "out" / "tradeoff.html").read_text()).text).split()
    )


def test_tradeoff__cells_of_runs_are_a_knob_with_errors_bytes_and_pictures(tmp_path, renderer):
    ball, settings = point_scan(tmp_path / "ball.ply"), settings_for("draft", geometry="runs", cell=0.1)
    found = tradeoff(ball, tmp_path / "out", settings, SerialExecutor(), Heard(), knobs=parsed_knobs(["cell=0.4"]))
    fine, coarse = found.points
    assert (fine.key, coarse.key) == ("chosen", "cell=0.4")
    assert coarse.command == "--preset draft --geometry runs --cell 0.4"
    assert coarse.splats < fine.splats and coarse.file_bytes < fine.file_bytes
    assert fine.picture_psnr_db == BEST_DB and coarse.picture_psnr_db < 40  # against the finest cells


def test_tradeoff__wrong_knobs_and_budgets_are_named(scan, tmp_path, capsys):
    for arguments, words in (
        (["--knob", "speed=9"], "knob 'speed=9' is not NAME=VALUE"),
        (["--budget", "soon"], "budget is 'soon'"),
    ):
        assert main(["tradeoff", str(scan), "--out", str(tmp_path / "o"), *arguments]) == 1
        assert words in capsys.readouterr().err


OTHER = {
    "weight_bits": 8,
    "max_atoms": 3,
    "target_psnr_db": 27.0,
    "training_splats": 500,
    "seed": 5,
    "budget_bytes": 60.0,
    "density": 0.5,
    "atom_search": "exact",
}


def test_knobs__the_stage_that_a_row_names_is_the_first_to_run_again(scan, tmp_path):
    """What docs/KNOBS.md promises of work folders."""

    def ran(changes: dict) -> list[str]:
        run = Run(tmp_path / "work", SerialExecutor(), Heard())
        settings = settings_for(
            "draft", **{"dictionary": "own", "target_psnr_db": 28.0, "training_splats": 600, "iterations": 1} | changes
        )
        code(run, prepare(run, scan, settings.radius, settings.effects, density=settings.density), settings)
        return [r.name for r in run.records if not r.reused]

    assert ran({})[0] == "ingest"
    for name, value in OTHER.items():
        assert ran({name: value})[0] == BY_NAME[name].stage, name
