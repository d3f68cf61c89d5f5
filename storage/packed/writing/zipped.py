"""What a zip says of its members, byte for byte as Python's zipfile writes it: stored, of 1980, from a Unix.

zipfile takes members one after the other and holds all of them in memory. A packed file's are laid out by as many tasks
as there are, and of 10 billion splats there are 15 million: here they are rows of an array.

Reference: APPNOTE.TXT, sections 4.3.7 to 4.3.16.
"""

from __future__ import annotations

import struct

import numpy as np

LONGEST, MOST_MEMBERS = (1 << 31) - 1, (1 << 16) - 1  # beyond which zipfile writes zip64
_PLAIN, _ZIP64, _UNIX = 20, 45, 3  # versions that a reader needs; the system
_NO_TIME, _FIRST_DAY = 0, 1 << 5 | 1  # 1 January 1980
_RIGHTS = 0o644 << 16
_ENTRY = np.dtype(
    [("magic", "S4"), ("made", "u1"), ("system", "u1"), ("version", "u1"), ("reserved", "u1"), ("flags", "<u2")]
    + [("stored", "<u2"), ("time", "<u2"), ("day", "<u2"), ("crc", "<u4"), ("packed", "<u4"), ("size", "<u4")]
    + [("name", "<u2"), ("extra", "<u2"), ("comment", "<u2"), ("disk", "<u2"), ("internal", "<u2")]
    + [("rights", "<u4"), ("at", "<u4")]
)
_FAR = np.dtype([("kind", "<u2"), ("bytes", "<u2"), ("at", "<u8")])  # of a member beyond LONGEST


def local_header(name: str, crc: int, size: int) -> bytes:
    """What stands before a member's bytes."""
    plain = (_PLAIN, 0, 0, 0, _NO_TIME, _FIRST_DAY, crc, size, size, len(name), 0)
    return struct.pack("<4s2B4HL2L2H", b"PK\3\4", *plain) + name.encode()


def entries_in_rows(
    names: list[tuple[str, str]], first: int, crc: np.ndarray, size: np.ndarray, at: np.ndarray
) -> bytes:
    """What the directory says of members (n, k), of which the k-th of row i is called names[k] with the number `first`
    + i between: `entries` of them row by row, without a loop over them where all numbers are as long and all lie near,
    or far."""
    number = first + np.arange(len(crc))
    far = at > LONGEST
    n_digits = len(str(first))
    if len(str(first + len(crc) - 1)) != n_digits or far.any() != far.all():
        flat = [f"{before}{i}{after}" for i in number.tolist() for before, after in names]
        return entries(flat, crc.ravel(), size.ravel(), at.ravel())
    digits = (number[:, None] // 10 ** np.arange(n_digits - 1, -1, -1) % 10 + ord("0")).astype(np.uint8)
    columns = []
    for k, (before, after) in enumerate(names):
        fixed, extra = _fields(len(before) + n_digits + len(after), crc[:, k], size[:, k], at[:, k])
        columns += [_as_bytes(fixed), _repeated(before, len(crc)), digits, _repeated(after, len(crc))]
        columns += [_as_bytes(extra)] if far.any() else []
    return np.concatenate(columns, axis=1).tobytes()


def _as_bytes(rows: np.ndarray) -> np.ndarray:
    return rows.view(np.uint8).reshape(len(rows), -1)


def _repeated(text: str, n: int) -> np.ndarray:
    return np.broadcast_to(np.frombuffer(text.encode(), np.uint8), (n, len(text)))


def entries(names: list[str], crc: np.ndarray, size: np.ndarray, at: np.ndarray) -> bytes:
    """What the directory says of members (m,): their CRC-32, bytes, and where their local headers begin."""
    rows, extra = _fields(np.array([len(name) for name in names]), crc, size, at)
    far = (np.asarray(at) > LONGEST).tolist()
    plain, beyond, width, wide = rows.tobytes(), extra.tobytes(), _ENTRY.itemsize, _FAR.itemsize
    return b"".join(
        plain[i * width : (i + 1) * width] + name.encode() + (beyond[i * wide : (i + 1) * wide] if is_far else b"")
        for i, (name, is_far) in enumerate(zip(names, far))
    )


def _fields(name: np.ndarray | int, crc: np.ndarray, size: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is as long for all members, and what those that lie far have besides, (m,) each; `name` is the length of
    theirs."""
    rows, extra = np.zeros(len(crc), _ENTRY), np.zeros(len(crc), _FAR)
    for field, value in (("magic", b"PK\1\2"), ("made", _PLAIN), ("system", _UNIX), ("version", _PLAIN)):
        rows[field] = value
    for field, value in (("time", _NO_TIME), ("day", _FIRST_DAY), ("rights", _RIGHTS)):
        rows[field] = value
    rows["crc"], rows["packed"], rows["size"], rows["at"] = crc, size, size, np.minimum(at, 0xFFFFFFFF)
    rows["name"] = name
    far = np.asarray(at) > LONGEST
    for field, value in (("made", _ZIP64), ("version", _ZIP64), ("extra", _FAR.itemsize), ("at", 0xFFFFFFFF)):
        rows[field][far] = value
    extra["kind"], extra["bytes"], extra["at"] = 1, 8, at
    return rows, extra


def end_of(n_members: int, at: int, n_bytes: int, comment: int) -> bytes:
    """What stands behind a directory of `n_members` in `n_bytes` from `at` on, up to a comment of so many bytes."""
    far = b""
    if n_members > MOST_MEMBERS or at > LONGEST or n_bytes > LONGEST:
        record = (44, _ZIP64, _ZIP64, 0, 0, n_members, n_members, n_bytes, at)
        far = struct.pack("<4sQ2H2L4Q", b"PK\6\6", *record) + struct.pack("<4sLQL", b"PK\6\7", 0, at + n_bytes, 1)
    n, there, size = min(n_members, 0xFFFF), min(at, 0xFFFFFFFF), min(n_bytes, 0xFFFFFFFF)
    return far + struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, n, n, size, there, comment)
