"""Every line of README's shell blocks that needs no service, run in order, on a small scan in place of the demo's."""

import re
import shlex
from pathlib import Path

import pytest

from services.cli.main import main
from tests.services.scans import photo_scan

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "README.md").read_text()
LINES = [shlex.split(line, comments=True)[1:] for line in re.findall(r"^    (\.venv/bin/splatpress .*)$", TEXT, re.M)]
SERVICE = {"serve", "submit", "fetch", "ls", "regress", "token", "login"}  # tests/services/test_service.py has these
WAITS = {"view"}  # until it is stopped; tests/services/web has it
WITH_WORKERS = {"compress", "report", "estimate", "tradeoff", "effects", "pages"}
HERE = ["--executor", "serial"]  # workers take seconds to start
IN_PLACE_OF = {"90s": "5s", "1280x720": "96x54"}


def test_readme__its_lines_are_those_of_commands_that_there_are():
    assert len(LINES) > 12
    for line in LINES:
        with pytest.raises(SystemExit) as stop:
            main([line[0], "--help"])
        assert stop.value.code == 0


def test_readme__each_line_runs_after_those_before_it(tmp_path, monkeypatch, capsys, renderer):
    monkeypatch.chdir(tmp_path)
    photo_scan(tmp_path / "demo-output" / "scan", n_side=40)
    ran = 0
    for line in LINES:
        if line[0] in SERVICE | WAITS:
            continue
        arguments = [IN_PLACE_OF.get(word, word) for word in line] + HERE * (line[0] in WITH_WORKERS)
        assert main(arguments) == 0, (arguments, capsys.readouterr().err)
        ran += 1
    assert ran >= 9
    assert (tmp_path / "OUT" / "scan.splatpress").is_file() and (tmp_path / "scan.ply").is_file()


def test_readme__pictures_and_documents_that_it_names_are_there():
    named = re.findall(r"\]\(([\w/.-]+)\)", TEXT) + re.findall(r"`((?:docs|deploy)/[\w.]+|[A-Z]+\.md)`", TEXT)
    assert named and not [name for name in named if not (ROOT / name).exists()]
