"""The list of expected figures: what is wrong with one is told before a job is submitted, and compared is what can
be."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.cli import regress as module
from services.cli.main import main
from services.cli.regress import _compare, _updated, read_list
from tests.services.service_process import free_port

GOOD = '[[job]]\nname = "a"\nscan = "a.ply"\npreset = "draft"\nexpected = { seconds = 10.0, file_bytes = 5 }\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no [[job]] in it"),
        ("# all commented out\n", "no [[job]] in it"),
        ("job = []\n", "no [[job]] in it"),
        ("[[job]\nscan = 1\n", "(at line 1, column"),
        ('[[job]]\nscan = "a.ply"\npreset = draft\n', "(at line 3, column 10)"),
        (GOOD + "expectd = 3\n", "job 1 (a): 'expectd' is no key of it; allowed: name, scan,"),
        ("title = 1\n" + GOOD, "'title' is no key"),
        (
            GOOD.replace("file_bytes", "psnr"),
            "expected: 'psnr' is no key of it; allowed: texture_psnr_db, file_bytes, seconds",
        ),
        (GOOD.replace("10.0", '"ten"'), "expected.seconds is 'ten'; allowed: a number"),
        (GOOD + "options = { iteration = 2 }\n", "options: 'iteration' is no key"),
        (GOOD + "options = { iterations = 0 }\n", "iterations is 0"),
        (GOOD.replace('"draft"', '"drafty"'), "drafty"),
        (GOOD.replace("a.ply", "b.ply"), "b.ply: no such file or folder"),
        (GOOD.replace('scan = "a.ply"', ""), "no scan"),
    ],
)
def test_regress__a_list_that_is_none_is_an_error_before_anything_is_asked(tmp_path, capsys, text, words):
    (tmp_path / "a.ply").touch()
    (tmp_path / "jobs.toml").write_text(text)
    assert main(["regress", str(tmp_path / "jobs.toml"), "--url", f"http://127.0.0.1:{free_port()}"]) == 1
    said = capsys.readouterr().err
    assert words in said and str(tmp_path / "jobs.toml") in said and len(said.splitlines()) == 1


def test_regress__seconds_of_reused_stages_are_not_compared(tmp_path):
    (tmp_path / "a.ply").touch()
    job = read_list(GOOD, tmp_path / "jobs.toml")[0]
    found = {"status": "successful", "texture_psnr_db": None, "file_bytes": 5, "seconds": 99.0, "n_reused": 0}
    assert [row["ok"] for row in _compare(job, found)] == [False, True]
    rows = _compare(job, {**found, "seconds": 0.1, "n_reused": 3})
    assert [row["ok"] for row in rows] == [True, True] and rows[0][
        "measured"
    ] == "not compared: 3 stages were there already"
    assert "seconds = 10.0" in _updated(GOOD, [job], [{**found, "seconds": 0.1, "n_reused": 3}])
    assert "seconds = 99.0" in _updated(GOOD, [job], [found])


def test_regress__the_example_in_its_docstring_is_a_list(tmp_path):
    text = module.__doc__.partition("\n\n")[2]
    base = tmp_path / "a" / "b"
    scan = base / "../shared/data/fountain_p11"
    base.mkdir(parents=True)
    Path(scan).resolve().mkdir(parents=True)
    assert len(read_list(text, base / "jobs.toml")) == 1
