"""docs/KNOBS.md, made from the table of knobs and the presets: `python -m services.docs.knobs` writes it again."""

from __future__ import annotations

from pathlib import Path

from pipeline.planning.knobs import KNOBS, VIEW_KNOBS, Knob
from pipeline.planning.settings import DEFAULT_PRESET, PRESETS
from services.docs.tables import table

PATH = Path(__file__).resolve().parents[2] / "docs" / "KNOBS.md"
_HEAD = """# Knobs: what trades accuracy for time and bytes

Made from `pipeline/planning/knobs.py` and `pipeline/planning/settings.py` by `python -m services.docs.knobs`; change
those. Each knob is an argument of `splatpress compress` (`--dictionary-bits`) and an option of a job
(`dictionary_bits`). A change runs the named stage again and those after it; with a work folder all before it are
reused.
"""


def document() -> str:
    """The text of docs/KNOBS.md."""
    knobs = table(("knob", "what", "allowed", "buys", "costs", "runs again from"), map(_row, KNOBS))
    names = [knob.name for knob in KNOBS if knob.name != "seed"]
    presets = table(
        ("preset", *names), ((_preset_name(p), *(_shown(getattr(s, n)) for n in names)) for p, s in PRESETS.items())
    )
    views = table(("knob", "what", "allowed", "buys", "costs"), (_row(knob)[:-1] for knob in VIEW_KNOBS))
    return f"{_HEAD}\n## The table\n\n{knobs}\n## Presets\n\n{presets}\n## Of a picture\n\nArguments of `splatpress render`; no file changes.\n\n{views}"


def _row(knob: Knob) -> tuple[str, ...]:
    return (f"`{knob.name}`", knob.help, knob.allowed, knob.buys, knob.costs, knob.stage)


def _preset_name(name: str) -> str:
    return f"`{name}`, the default" if name == DEFAULT_PRESET else f"`{name}`"


def _shown(value) -> str:
    return (
        "automatic"
        if value is None
        else f"{value:,g}"
        if isinstance(value, float)
        else f"{value:,}"
        if isinstance(value, int)
        else str(value)
    )


if __name__ == "__main__":
    PATH.write_text(document())
