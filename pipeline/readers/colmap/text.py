"""Text models made plain before a library reads them: what people and programs write by hand is understood, or named by line and column.

Understood are byte order marks, UTF-16, any line end, images without their second line, and quaternions of four digits.

References: COLMAP, "Output Format"; src/colmap/scene/reconstruction_io.cc.
"""

from __future__ import annotations

import codecs
import io
import math
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import BinaryIO

from pipeline.readers.files.spelling import name_of, shown
from storage.errors import InvalidScan, UnsupportedScan

MAX_LINE_BYTES = 1 << 28  # a photo with 10 million image points in one line of images.txt
WHOLE_SPHERES = ("EQUIRECTANGULAR", "SPHERE", "SPHERICAL")  # of COLMAP, OpenMVG and Metashape: no pinhole shows them
MAX_TEXT_BYTES = 1 << 26  # cameras.txt, rigs.txt, frames.txt

_N_POSE = 7  # quaternion w x y z, translation x y z
_BOMS = ((codecs.BOM_UTF8, "latin-1"), (codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be"))


def _lines(stream: BinaryIO, where: str) -> Iterator[tuple[int, str]]:
    """Numbered lines; a character a byte, but of UTF-16."""
    begun = stream.read(4)
    bom, encoding = next(((b, e) for b, e in _BOMS if begun.startswith(b)), (b"", "latin-1"))
    stream.seek(len(bom))
    text, number = io.TextIOWrapper(stream, encoding, errors="replace"), 0
    try:
        while line := text.readline(MAX_LINE_BYTES):
            number += 1
            if len(line) == MAX_LINE_BYTES:
                raise InvalidScan(f"{where}:line {number}", f"a line of {MAX_LINE_BYTES} bytes", "shorter lines")
            if encoding != "latin-1":
                line = line.encode("utf-8").decode("latin-1")
            yield number, line.rstrip("\n")
    finally:
        with suppress(ValueError):  # the stream is closed already
            text.detach()


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith("#")


def _number(line: str, word: re.Match, where: str, number: int, kind: type = float):
    text = word[0]
    try:
        value = kind(text)
        if "_" in text or not math.isfinite(value):
            raise ValueError
    except ValueError:
        hint = "decimals are written with a point" if re.fullmatch(r"[-+]?\d+,\d+\S*", text) else ""
        what = "a whole number" if kind is int else "a finite number"
        found = f"{shown(name_of(text[:40].encode('latin-1')))!r}"
        raise InvalidScan(f"{where}:line {number}, column {word.start() + 1}", found, what, hint) from None
    return value


def _is_points(line: str) -> bool:
    """Whether a line is the second of an image: triples of numbers, or nothing."""
    words = line.split()
    if len(words) % 3:
        return False
    try:
        for word in words[:12]:
            float(word)
    except ValueError:
        return False
    return True


def plain_images(stream: BinaryIO, where: str, token_of: Callable[[int, str], bytes]) -> tuple[bytes, list[str]]:
    """images.txt with its second lines left empty and quaternions of length 1, and warnings.

    `token_of` gives what is written in place of a name, of an image's number and name.
    Raises: InvalidScan naming line and column.
    """
    kept, warnings, n_bare, n_images, wants_points = [], [], 0, 0, False
    for number, line in _lines(stream, where):
        if wants_points and _is_points(line):
            wants_points = False
            continue
        if not line.strip() or _is_comment(line):
            continue
        n_bare += wants_points  # an image follows at once
        words = list(re.finditer(r"\S+", line))
        if len(words) < _N_POSE + 3:
            found = f"{len(words)} values in {line.strip()[:60]!r}"
            raise InvalidScan(f"{where}:line {number}", found, "number, quaternion, translation, camera, name")
        image_id = _number(line, words[0], where, number, int)
        pose = [_number(line, w, where, number) for w in words[1 : _N_POSE + 1]]
        camera_id = _number(line, words[_N_POSE + 1], where, number, int)
        if not 0 <= image_id < 1 << 32 or not 0 <= camera_id < 1 << 32:
            raise InvalidScan(f"{where}:line {number}", f"image {image_id}, camera {camera_id}", "0 to 4294967295")
        length = math.sqrt(sum(q * q for q in pose[:4]))
        if length == 0:
            column = words[1].start() + 1
            raise InvalidScan(f"{where}:line {number}, column {column}", "a quaternion of 0", "a rotation")
        name = name_of(line[words[_N_POSE + 2].start() :].rstrip().encode("latin-1", "replace"))
        pose = [q / length for q in pose[:4]] + pose[4:]
        token = token_of(image_id, name)
        kept.append(f"{image_id} {' '.join(map(repr, pose))} {camera_id} ".encode() + token + b"\n\n")
        n_images, wants_points = n_images + 1, True
    if n_bare:
        n_bare += wants_points
        found = f"{n_bare} of {n_images} images have no second line of image points"
        warnings.append(f"{where}: {found}; read as one line an image")
    return b"".join(kept), warnings


def plain_cameras(stream: BinaryIO, where: str, n_params: dict[str, int]) -> bytes:
    """cameras.txt, checked; `n_params` says how many parameters each model has.

    Raises: InvalidScan naming line and column; UnsupportedScan for a model by its name.
    """
    kept = []
    for number, line in _lines(stream, where):
        if not line.strip() or _is_comment(line):
            continue
        words = list(re.finditer(r"\S+", line))
        if len(words) < 4:
            raise InvalidScan(
                f"{where}:line {number}", f"{len(words)} values", "number, model, width, height, parameters"
            )
        model = words[1][0]
        if model not in n_params or model in WHOLE_SPHERES:
            handled = ", ".join(name for name in n_params if name not in WHOLE_SPHERES)
            hint = "make pinhole photographs of it first, such as six sides of a cube" if model in WHOLE_SPHERES else ""
            raise UnsupportedScan(f"{where}:line {number}", f"camera model {model[:40]}", handled, hint)
        whole = [_number(line, w, where, number, int) for w in (words[0], words[2], words[3])]
        params = [_number(line, w, where, number) for w in words[4:]]
        if len(params) != n_params[model]:
            found = f"{len(params)} parameters of camera model {model}"
            raise InvalidScan(f"{where}:line {number}", found, f"{n_params[model]}")
        if not 0 <= whole[0] < 1 << 32 or min(whole[1:]) < 0 or max(whole[1:]) >= 1 << 31:
            found = f"camera {whole[0]} of {whole[1]}x{whole[2]} pixels"
            raise InvalidScan(f"{where}:line {number}", found, "numbers of 32 bits")
        kept.append(f"{whole[0]} {model} {whole[1]} {whole[2]} {' '.join(map(repr, params))}\n".encode())
    return b"".join(kept)


def plain_text(stream: BinaryIO, where: str) -> bytes:
    """rigs.txt and frames.txt, with lines that end with LF and without a byte order mark."""
    kept, n_bytes = [], 0
    for _, line in _lines(stream, where):
        n_bytes += len(line) + 1
        if n_bytes > MAX_TEXT_BYTES:
            raise InvalidScan(where, f"more than {MAX_TEXT_BYTES} bytes", f"at most {MAX_TEXT_BYTES}")
        kept.append(line.encode("latin-1", "replace") + b"\n")
    return b"".join(kept)
