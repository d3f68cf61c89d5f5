"""Text files of numbers, line by line, whatever lines end with: each with its number, for people who have to find it."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import suppress
from typing import BinaryIO

MAX_LINE_BYTES = 1 << 16
COMMENTS = ("#", "//", "%")


def numbered_lines(stream: BinaryIO, skip_comments: bool = True) -> Iterator[tuple[int, str]]:
    """Lines that are neither empty nor, perhaps, comments."""
    text = io.TextIOWrapper(stream, "utf-8-sig", errors="replace")
    number = 0
    try:
        while line := text.readline(MAX_LINE_BYTES):
            number += 1
            if (words := line.strip()) and not (skip_comments and words.startswith(COMMENTS)):
                yield number, line
    finally:
        with suppress(ValueError):  # the stream is closed already
            text.detach()
