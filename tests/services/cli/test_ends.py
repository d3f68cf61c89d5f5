"""How a command ends that is stopped, or that a service refuses, and in whose words it says so."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from services.cli.answers import ServiceError
from services.cli.main import main
from services.cli.wording import as_options
from tests.services.scans import photo_scan, point_scan
from tests.services.service_process import ROOT, until


def test_compress__sigterm_leaves_nothing_behind_and_no_stack_trace(tmp_path):
    scan = photo_scan(tmp_path / "plane", n_side=24)
    command = [sys.executable, "-m", "services.cli", "compress", str(scan), "--out", str(tmp_path / "o")]
    process = subprocess.Popen(
        [*command, "--executor", "serial", "--no-render", "--preset", "draft"],
        env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    until(lambda: [*tmp_path.glob(".o.*/work/partition-*")], every=0.01)  # the scan was read, by pycolmap
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 143 and err.splitlines()[-1] == "splatpress: terminated" and "***" not in err
    assert [path.name for path in tmp_path.iterdir()] == ["plane"]


@pytest.mark.parametrize(
    "status, kind, code, title",
    [(404, "data", 1, "no such job"), (401, "data", 1, "no such job"), (422, "data", 3, "data error"), (500, "internal", 4, "internal error")],
)  # fmt: skip
def test_answers__what_was_asked_for_wrongly_is_no_error_of_data(status, kind, code, title):
    error = ServiceError(status, {"title": "no such job", "detail": "no job 0", "class": kind})
    assert (error.exit_code, error.title) == (code, title)


def test_wording__knobs_are_options_where_somebody_types(tmp_path, capsys):
    assert as_options("budget_bytes: 3 bytes a splat") == "--budget-bytes: 3 bytes a splat"
    assert as_options("texture: map, of a scan; allowed: auto") == "--texture: map, of a scan; allowed: auto"
    told = "a.ply: no texture; atom_size 8 and levels 2; in budget_bytes.txt"
    assert as_options(told) == "a.ply: no texture; --atom-size 8 and levels 2; in budget_bytes.txt"
    point_scan(tmp_path / "a.ply", 200)
    arguments = ["--texture", "map", "--executor", "serial", "--no-render"]
    assert main(["compress", str(tmp_path / "a.ply"), "--out", str(tmp_path / "o"), *arguments]) == 3
    assert "splatpress: data error: --texture: map, of a scan without stations" in capsys.readouterr().err


def test_benchmarks__say_in_a_line_which_packages_they_lack():
    hide = "import sys; sys.modules['pytest'] = None; import runpy; "
    run = "runpy.run_module('benchmarks.service', run_name='__main__')"
    ended = subprocess.run(
        [sys.executable, "-c", hide + run], capture_output=True, text=True, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )  # fmt: skip
    assert ended.returncode == 1 and len(ended.stderr.splitlines()) == 1 and "with-tests" in ended.stderr


def test_cli__says_its_options_before_anything_heavy_could_be_imported():
    heavy = "{'numpy', 'numba', 'scipy', 'zarr', 'dask', 'httpx', 'msgspec', 'sqlalchemy', 'PIL', 'difflib', 'socket'}"
    look = (
        "import sys; from services.cli.parser import Commands; all = Commands(); [all[name].format_help() for name in all]; "
        f"print(sorted({heavy} & set(sys.modules)))"
    )
    ended = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, cwd=ROOT)
    assert ended.stdout == "[]\n", ended.stderr
