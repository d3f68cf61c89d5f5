"""LZF, which packs PCD files.

References: M. Lehmann, liblzf: a control byte below 32 starts a run of literals, others refer back.
"""

from __future__ import annotations

import numpy as np

from pipeline.execution.compiled import kernel

MOST_RATIO = 264 / 3  # a reference of 3 bytes stands for 264 at most


def unpack(packed: np.ndarray, n_bytes: int) -> np.ndarray | None:  # (n_bytes,) uint8
    """The unpacked bytes; None where they are not so many, or refer to what is not there."""
    if n_bytes > MOST_RATIO * len(packed) + 1:
        return None
    unpacked = np.zeros(n_bytes, np.uint8)
    return unpacked if _unpack(packed, unpacked) == n_bytes else None


@kernel()
def _unpack(packed, unpacked):
    """How many bytes were made; -1 for what cannot be."""
    at, to = 0, 0
    while at < len(packed):
        control = int(packed[at])
        at += 1
        if control < 32:
            n = control + 1
            if at + n > len(packed) or to + n > len(unpacked):
                return -1
            for i in range(n):
                unpacked[to + i] = packed[at + i]
            at, to = at + n, to + n
            continue
        n = control >> 5
        if n == 7:
            if at >= len(packed):
                return -1
            n += int(packed[at])
            at += 1
        if at >= len(packed):
            return -1
        back = to - ((control & 31) << 8) - int(packed[at]) - 1
        at, n = at + 1, n + 2
        if back < 0 or to + n > len(unpacked):
            return -1
        for i in range(n):
            unpacked[to + i] = unpacked[back + i]
        to += n
    return to
