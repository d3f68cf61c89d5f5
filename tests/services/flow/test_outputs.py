"""What is looked at of a packed file for its report: all of it, or of a large one some groups and the totals."""

from __future__ import annotations

from pathlib import Path

from renderer.report.report import as_json, build_report
from renderer.report.report_page import page_of
from services.flow import outputs
from storage.packed.packed import PackedFile
from storage.packed.schema import GROUP
from tests.packed_files import Case, write_packed_file


def test_outputs__of_a_large_file_some_groups_and_the_totals_of_all(tmp_path: Path, monkeypatch):
    case = Case(n_splats=3 * GROUP + 9, period=128, n_dictionary=300, dictionary_bits=9)
    path = write_packed_file(case, tmp_path / "a.splatpress")
    with PackedFile(path) as packed:
        scene, totals = outputs._looked_at(packed)
        assert totals is None and scene.header.n_splats == case.n_splats
        whole = as_json(build_report(scene, 7))
        assert "as counted in" not in page_of(whole, scene, tmp_path)
        monkeypatch.setattr(outputs, "GROUPS", 2)
        some, totals = outputs._looked_at(packed)
    assert some.header.n_splats == GROUP + 9
    report = as_json(build_report(some, 7, totals=totals))
    assert report == whole
    page = page_of(report, some, tmp_path)
    assert f"as counted in {some.header.n_splats:,} splats" in page.replace("\u202f", ",").replace("&nbsp;", ",")
