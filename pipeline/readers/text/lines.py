"""Text files of numbers, line by line, whatever lines end with: each with its number, for people who have to find it."""

from __future__ import annotations

import codecs
import io
from collections.abc import Iterator
from contextlib import suppress
from typing import BinaryIO

MAX_LINE_BYTES = 1 << 16
COMMENTS = ("#", "//", "%")


def numbered_lines(stream: BinaryIO, skip_comments: bool = True) -> Iterator[tuple[int, str]]:
    """Lines that are neither empty nor, perhaps, comments; UTF-8, or UTF-16 where a byte order mark says so."""
    begin = stream.peek(2)[:2] if isinstance(stream, io.BufferedReader) else b""
    encoding = "utf-16" if begin in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig"
    text = io.TextIOWrapper(stream, encoding, errors="replace")
    number = 0
    try:
        while line := text.readline(MAX_LINE_BYTES):
            number += 1
            if (words := line.strip()) and not (skip_comments and words.startswith(COMMENTS)):
                yield number, line
    finally:
        with suppress(ValueError):  # the stream is closed already
            text.detach()
