"""docs/NUMERICS.md names tests that exist."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_numerics__every_test_that_the_table_names_exists():
    named = set(re.findall(r"`(test_\w+__\w+)`", (ROOT / "docs" / "NUMERICS.md").read_text()))
    there = {
        name
        for path in (ROOT / "tests").rglob("test_*.py")
        for name in re.findall(r"^def (test_\w+)", path.read_text(), re.M)
    }
    assert len(named) > 30 and not named - there


def test_numerics__every_naive_formulation_is_used_by_a_hard_case():
    reference = (ROOT / "tests" / "reference.py").read_text().split("# --- naive formulations")[1]
    cases = "".join(path.read_text() for path in (ROOT / "tests" / "hard_cases").glob("test_*.py"))
    functions = re.findall(r"^def (\w+)", reference, re.M)
    assert len(functions) > 8 and all(f"reference.{name}(" in cases for name in functions)
