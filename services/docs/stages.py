"""The table of docs/PIPELINE.md, made from the catalogue of stages: `python -m services.docs.stages` writes it
again."""

from __future__ import annotations

from pathlib import Path

from pipeline.catalogue import CATALOGUE, StageEntry
from pipeline.planning.knobs import KNOBS
from services.docs.tables import table

PATH = Path(__file__).resolve().parents[2] / "docs" / "PIPELINE.md"
BEGIN, END = "<!-- made by services/docs/stages.py -->\n", "<!-- end -->\n"


def document(text: str) -> str:
    """docs/PIPELINE.md with the table as the catalogue has it today."""
    before, rest = text.split(BEGIN)
    after = rest.split(END)[1]
    head = ("stage", "file", "a task is", "what it makes", "when", "% of a job", "knobs that run it again")
    return before + BEGIN + table(head, map(_row, CATALOGUE)) + END + after


def _row(entry: StageEntry) -> tuple[str, ...]:
    knobs = ", ".join(f"`{knob.name}`" for knob in KNOBS if knob.stage == entry.name)
    return (entry.name, f"`{entry.file}`", entry.task, entry.makes, entry.when or "always", f"{entry.share:g}", knobs)


if __name__ == "__main__":
    PATH.write_text(document(PATH.read_text()))
