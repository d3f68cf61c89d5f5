"""Tables of Markdown."""

from __future__ import annotations

from collections.abc import Iterable


def table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """A row a line.

    >>> print(table(("knob", "what"), [("seed", "of choices")]), end="")
    | knob | what |
    | --- | --- |
    | seed | of choices |
    """
    lines = [head, ("---",) * len(head), *rows]
    return "".join("| " + " | ".join(cells) + " |\n" for cells in lines)
