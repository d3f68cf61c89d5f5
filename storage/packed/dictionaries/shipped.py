"""Dictionaries that ship with the program: packed files name one by its hash in place of holding atoms.

A file `<first 16 digits>.atoms` is one zstd frame of the planes green, red less green, blue less green, each (k, 16, 16)
int8 in STEPs of a texel, and the scales (k,) float32, little-endian. Its name is the SHA-256 of what readers make of
that: texels (k, 16, 16, 3) int8, then the scales. `python -m benchmarks.shipped_dictionary` makes it. A file once
shipped stays, as packed files name it for ever.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numcodecs.zstd import Zstd

from storage.errors import InternalError, InvalidPackedFile

FOLDER = Path(__file__).parent
SUFFIX = ".atoms"
ATOM_SIZE = 16  # texels to a side of all of them
STEP = 2  # of texels: 7 bits are 36 dB below what an atom shows, and a third fewer bytes than 8
N_ATOMS = 512  # of the newest
ATOM_BYTES = 3 * ATOM_SIZE**2 + 4  # its texels, and its scale
NEWEST = "c033009344d22447da88ef22e3d37e01d8f47f77dd5fd99a537ca8011b9d609f"  # the one that jobs use
ZSTD_LEVEL = 22


@dataclass(frozen=True)
class Shipped:
    """One of them, its atoms in the order in which they are used, the most used first."""

    name: str  # 64 hexadecimal digits
    texels: np.ndarray  # (k, 16, 16, 3) int8
    scale: np.ndarray  # (k,) float32


def name_of(texels: np.ndarray, scale: np.ndarray) -> str:
    """The name of the dictionary of texels (k, 16, 16, 3) int8 and scales (k,) float32."""
    return hashlib.sha256(texels.tobytes() + scale.astype("<f4").tobytes()).hexdigest()


def check_shipped(where: str, name: str) -> None:
    """Raises InvalidPackedFile of the file `where` unless this program has the dictionary that it names."""
    known = sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}"))
    if name[:16] not in known and name != NEWEST:
        found = f"atoms of the dictionary {name[:16]}, which this program does not have"
        raise InvalidPackedFile(where, found, ", ".join(known), "a newer splatpress may have it")


def file_of(name: str) -> Path:
    """Where the dictionary of that name lies."""
    return FOLDER / (name[:16] + SUFFIX)


@cache
def shipped(name: str = NEWEST) -> Shipped:
    """The dictionary of that name. Its arrays are read-only.

    Raises: InternalError where its file is missing, or holds another: the installation is broken, not what is read.
    """
    path = file_of(name)
    try:
        texels, scale = unpacked(path.read_bytes())
    except (OSError, ValueError, RuntimeError) as error:
        raise InternalError(path.name, f"a dictionary that ships with the program: {error}", "", _REMEDY) from error
    if (found := name_of(texels, scale)) != name:
        raise InternalError(path.name, f"atoms of the dictionary {found[:16]}", name, _REMEDY)
    texels.flags.writeable = scale.flags.writeable = False
    return Shipped(name, texels, scale)


_REMEDY = "install the program again"


def packed_bytes(texels: np.ndarray, scale: np.ndarray) -> bytes:
    """The file of texels (k, 16, 16, 3) int8, all whole STEPs, and scales (k,) float32."""
    in_steps = (texels // STEP).astype(np.int8)
    assert np.array_equal(in_steps * STEP, texels), "texels between two steps"
    red, green, blue = np.moveaxis(in_steps, 3, 0)
    planes = np.stack([green, red - green, blue - green])
    return Zstd(ZSTD_LEVEL).encode(planes.tobytes() + scale.astype("<f4").tobytes())


def unpacked(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Texels and scales of a file. Raises ValueError or RuntimeError where bytes are not those of whole atoms."""
    raw = Zstd().decode(data)
    n, rest = divmod(len(raw), ATOM_BYTES)
    if rest or not n:
        raise ValueError(f"{len(raw)} bytes, not {ATOM_BYTES} an atom")
    texel_bytes = n * (ATOM_BYTES - 4)
    planes = np.frombuffer(raw, np.int8, texel_bytes).reshape(3, n, ATOM_SIZE, ATOM_SIZE)
    green = planes[0]
    texels = STEP * np.stack([planes[1] + green, green, planes[2] + green], axis=3)
    return texels, np.frombuffer(raw, "<f4", n, texel_bytes).astype(np.float32)


def write_shipped(folder: Path, texels: np.ndarray, scale: np.ndarray) -> tuple[str, Path]:
    """Writes the file of a dictionary into `folder`; its name, and where it lies."""
    name = name_of(texels, scale)
    path = folder / (name[:16] + SUFFIX)
    path.write_bytes(packed_bytes(texels, scale))
    return name, path
