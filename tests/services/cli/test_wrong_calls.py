"""Wrong calls: one line that names what was found and what is allowed, and the exit code that README promises."""

import io
from pathlib import Path

import pytest

from services.cli.commands import COMMANDS
from services.cli.commands.running import asked_token, program
from services.cli.main import main
from tests.services.scans import photo_scan, point_scan

CALLS = [
    ("", 1, "COMMAND"),
    ("comprss {scan} --out {tmp}/o", 1, "did you mean 'compress'?"),
    ("compress", 1, "SCAN, --out"),
    ("compress {scan}", 1, "--out"),
    ("compress --presett draft {scan} --out {tmp}/o", 1, "did you mean --preset?"),
    ("compress {scan} --out {tmp}/o --preset fast", 1, "draft, balanced, high, archive"),
    ("compress {scan} --out {tmp}/o --dictionary-bits 7", 1, "--dictionary-bits is 7; allowed"),
    ("compress {scan} --out {tmp}/o --weight-bits much", 1, "--weight-bits is much"),
    ("compress {scan} --out {tmp}/o --target-psnr-db nan", 1, "--target-psnr-db is nan"),
    ("compress {scan} --out {tmp}/o --density 0", 1, "density"),
    ("compress {scan} --out {tmp}/o --density 1.5", 1, "density"),
    ("compress {scan} --out {tmp}/o --radius -1", 1, "radius"),
    ("compress {scan} --out {tmp}/o --effects glow=on", 1, "glow"),
    ("compress {scan} --out {tmp}/o --workers none", 1, "--workers"),
    ("compress {scan} --out {tmp}/o --executor gpu", 1, "invalid choice: 'gpu' (choose from "),
    ("compress {scan} {points} --out {tmp}/o", 1, "unrecognized arguments"),
    ("compress {tmp}/nothing.ply --out {tmp}/o", 2, "nothing.ply"),
    ("compress {scan} --out {full}", 1, "--overwrite"),
    ("compress {empty} --out {tmp}/o --no-render", 3, "empty.ply"),
    ("compress {text} --out {tmp}/o --no-render", 5, "notes.doc"),
    ("inspect", 1, "SCAN"),
    ("inspect {tmp}/nothing", 2, "nothing"),
    ("inspect {empty}", 3, "empty.ply"),
    ("inspect {text}", 5, "notes.doc"),
    ("check {tmp}/nothing", 2, "nothing"),
    ("check {empty}", 3, "empty.ply"),
    ("render", 1, "PACKED"),
    ("render {empty} --orbit 2 --out {tmp}/o", 3, "empty.ply"),
    ("render {tmp}/nothing --orbit 2 --out {tmp}/o", 2, "nothing"),
    ("view {points} --no-open", 3, "a scan becomes one by `compress`"),
    ("view {scan} --no-open", 3, "a folder; allowed: a whole packed file"),
    ("render {empty} --orbit 2", 1, "--out"),
    ("render {empty} --orbit none --out {tmp}/o", 1, "--orbit"),
    ("render {empty} --orbit 2 --size big --out {tmp}/o", 1, "--size"),
    ("plan", 1, "--splats"),
    ("plan --splats lots", 1, "--splats"),
    ("plan --splats 1e6 --photographs -3", 1, "'-3' is not a whole number from 0 to 1,000,000"),
    ("plan --splats 1e6 --megapixels nan", 1, "'nan' is not a number of megapixels above 0"),
    ("plan --splats 1e6 --voxels 8e6 --stations 3", 1, "--stations: not allowed with argument --voxels"),
    ("tradeoff {scan} --out {tmp}/o --knob denisty=1", 1, "denisty"),
    ("tradeoff {scan} --out {tmp}/o --budget soon", 1, "90s, 10min or 2h"),
    ("evaluate {scan} --out {tmp}/o --rows d8w5", 1, "d8w5"),
    ("evaluate {points} --out {tmp}/o", 3, "no photographs; allowed: a scan with photographs"),
    ("tradeoff {points} --out {tmp}/o --no-render", 3, "no photographs; allowed: a scan with photographs"),
    ("evaluate {tmp}/nothing --out {tmp}/o", 2, "nothing"),
    ("estimate {tmp}/nothing", 2, "nothing"),
    ("effects {tmp}/nothing", 2, "nothing"),
    ("report {empty} --scan {scan} --out {tmp}/o", 3, "empty.ply"),
    ("regress {tmp}/nothing.toml", 2, "nothing.toml"),
]


def places_in(folder: Path) -> dict[str, Path]:
    """What the calls name, made in a folder; also for `benchmarks/wrong_calls.py`."""
    (folder / "full").mkdir()
    (folder / "full" / "a").write_text("a")
    (folder / "empty.ply").write_bytes(b"")
    (folder / "notes.doc").write_text("notes")
    return {
        "scan": photo_scan(folder / "scan", n_side=40),
        "points": point_scan(folder / "points.ply"),
        "full": folder / "full",
        "empty": folder / "empty.ply",
        "text": folder / "notes.doc",
        "tmp": folder,
    }


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    return places_in(tmp_path_factory.mktemp("falsche Aufrufe"))


@pytest.mark.parametrize(("call", "code", "words"), CALLS, ids=[call or "nothing" for call, _, _ in CALLS])
def test_cli__a_wrong_call_has_its_exit_code_and_one_line(places, capsys, call, code, words):
    arguments = [part.format(**places) for part in call.split()]
    try:
        found = main(arguments)
    except SystemExit as stop:
        found = stop.code
    out, said = capsys.readouterr()
    said = said or out  # what `check` finds is its output
    assert found == code, said
    assert len(said.splitlines()) == (2 if call.startswith("check") and code == 3 else 1) and words in said
    assert not (places["tmp"] / "o").exists()


def test_cli__help_of_compress_names_its_default_and_each_option_once(capsys):
    with pytest.raises(SystemExit):
        main(["compress", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert "default: balanced" in said and "--geometry auto|boxes|quadrics|runs how" in said
    assert (
        said.count("--iso VALUE[=#RRGGBB]") == 2 and "(auto, boxes, quadrics, runs)" not in said
    )  # usage, and options


def test_cli__says_how_a_shell_calls_it(tmp_path, monkeypatch):
    called = tmp_path / "Grüße an alle" / "splatpress"
    called.parent.mkdir()
    called.write_text("#!/bin/sh\n")
    called.chmod(0o755)
    monkeypatch.setattr("sys.argv", [str(called)])
    monkeypatch.setenv("PATH", str(tmp_path))
    assert program() == f"'{called}'"
    monkeypatch.setenv("PATH", str(called.parent))
    assert program() == "splatpress"
    monkeypatch.setattr("sys.argv", [str(tmp_path / "__main__.py")])
    monkeypatch.setenv("PATH", str(tmp_path))
    assert program() == "splatpress"


def test_cli__a_token_may_come_by_a_pipe(monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("sp_abc\n"))
    assert asked_token() == "sp_abc"


def test_cli__help_has_every_command_in_a_group(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    said = capsys.readouterr().out
    assert all(
        f"\n{title}:\n" in said and all(f"\n  {name} " in said for name in rows) for title, rows in COMMANDS.items()
    )
