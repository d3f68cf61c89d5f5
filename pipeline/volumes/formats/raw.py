"""Raw voxels with a sidecar: NAME.raw beside NAME.json, which says what the bytes are.

    {"sizes": [256, 256, 128], "type": "uint16", "endian": "little", "spacing": [0.5, 0.5, 1.0], "unit": "mm"}

`sizes` and `spacing` with the fastest axis first; `endian`, `spacing`, `origin` (3 numbers), `unit`, `skip_bytes` may be left out.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from pipeline.volumes.formats.stream import Slices, Stream, check_length
from pipeline.volumes.volume import Choice, Volume, checked, kept_dtype, unit_of
from storage.errors import InvalidScan

TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64", "float32", "float64")
_ALLOWED = "sizes of 3 whole numbers, type, and perhaps endian, spacing, origin, unit, skip_bytes"


def open_raw(path: str, choice: Choice = Choice()) -> Volume:
    """A volume by its sidecar. Raises InvalidScan."""
    sidecar = Path(path).with_suffix(".json")
    if not sidecar.is_file():
        raise InvalidScan(path, f"no sidecar {sidecar.name} beside it", f"{sidecar.name} with {_ALLOWED}")
    try:
        told = json.loads(sidecar.read_text())
        sizes = tuple(told["sizes"])
        assert len(sizes) == 3 and all(type(n) is int and n >= 1 for n in sizes) and told["type"] in TYPES
        assert told.get("endian", "little") in ("little", "big")
        spacing, origin = (
            [float(x) for x in told.get(name, default)]
            for name, default in (("spacing", (1, 1, 1)), ("origin", (0, 0, 0)))
        )
        skip, unit = int(told.get("skip_bytes", 0)), str(told.get("unit", ""))
        assert len(spacing) == len(origin) == 3 and skip >= 0
    except (ValueError, KeyError, TypeError, AttributeError, AssertionError) as error:
        raise InvalidScan(str(sidecar), "a key that is missing, or of another kind or value", _ALLOWED) from error
    dtype = np.dtype(told["type"]).newbyteorder(">" if told.get("endian") == "big" else "<")
    stream = Stream((path,), dtype, sizes, (0, 1, 2), skip_bytes=skip)
    kept = kept_dtype(dtype)
    notes = () if "spacing" in told else ("the sidecar says no spacing: every voxel is taken as a cube of side 1",)
    volume = Volume(
        path,
        "raw",
        sizes,
        kept,
        Slices(stream, kept),
        tuple(map(tuple, np.diag(spacing).tolist())),
        tuple(origin),  # type: ignore[arg-type]
        unit=unit_of(unit),
        warnings=(*notes, *check_length(stream)),
        details={"type": told["type"]},
        files=(path, str(sidecar)),
    )
    return checked(volume, choice)
