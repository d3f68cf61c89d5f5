"""docs/FAULTS.md names tests that are there: twelve faults and seven kills."""

from __future__ import annotations

import re

from tests.services.service_process import ROOT


def test_faults_document__every_fault_and_every_kill_has_its_test():
    text = (ROOT / "docs" / "FAULTS.md").read_text()
    _, faults, kills, _ = text.split("\n## ")
    for part, n in ((faults, 12), (kills, 7)):
        rows = [line for line in part.splitlines() if re.match(r"\| (?!---|fault|what)", line)]
        assert len(rows) == n and all("::test_" in row for row in rows), rows
    named = re.findall(r"`(tests/[\w/]+\.py)::(test_\w+)`", text)
    assert len(named) >= 19
    for file, test in named:
        assert f"\ndef {test}(" in (ROOT / file).read_text(), (file, test)
