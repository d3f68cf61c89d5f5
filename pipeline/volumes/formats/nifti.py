"""NIfTI-1, NIfTI-2 and Analyze pairs: the header through nibabel, the voxels as a stream.

Positions are the header's affine transform, millimetres to the right, front and top of the body; of its two transforms the
`sform` counts, then the `qform`. Values are `slope * voxel + intercept`, and iso values are meant in them.
"""

from __future__ import annotations

import gzip
import warnings
import zlib
from pathlib import Path

import nibabel
import numpy as np
from nibabel.filebasedimages import ImageFileError
from nibabel.spatialimages import HeaderDataError

from pipeline.volumes.formats.stream import Slices, Stream, check_length
from pipeline.volumes.volume import Choice, Volume, checked, chosen_axis, kept_dtype, unit_of
from storage.errors import InvalidScan, UnsupportedScan

LABELS = 1002  # intent code of volumes whose values name regions
_UNITS = {"mm": "mm", "meter": "m", "micron": "um"}


def open_nifti(path: str, choice: Choice = Choice()) -> Volume:
    """A volume by its header. Raises InvalidScan, UnsupportedScan."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image = nibabel.load(path)
            proxy, header, affine = image.dataobj, image.header, np.array(image.affine, np.float64)
            units = header.get_xyzt_units()[0] if hasattr(header, "get_xyzt_units") else "unknown"
    except (
        ImageFileError,
        HeaderDataError,
        EOFError,
        zlib.error,
        gzip.BadGzipFile,
        ValueError,
        KeyError,
        OverflowError,
    ) as error:
        raise InvalidScan(path, "its header cannot be read", "a NIfTI volume") from error
    dtype, sizes = proxy.dtype, tuple(int(n) for n in proxy.shape)
    if dtype.fields or dtype.kind not in "uif":
        raise UnsupportedScan(f"{path}:datatype", f"{dtype}", "one number a voxel, no colours nor complex numbers")
    if len(sizes) < 3 or min(sizes) < 1:
        raise InvalidScan(f"{path}:dim", f"{list(sizes)}", "3 sizes or more, of 1 or more")
    chosen = tuple(
        (axis, chosen_axis(path, kind, sizes[axis], choice.time if kind == "time" else choice.component))
        for axis, kind in zip(range(3, len(sizes)), ("time", "component", "component", "component"))
    )
    file = image.file_map["image"].filename or path
    slope, intercept = float(proxy.slope), float(proxy.inter)
    stream = Stream((file,), dtype, sizes, (0, 1, 2), chosen, _encoding(file), 0, int(proxy.offset), slope, intercept)
    kept = kept_dtype(dtype, scaled=(slope, intercept) != (1.0, 0.0))
    transforms = {name: int(header[f"{name}_code"]) for name in ("sform", "qform") if f"{name}_code" in header}
    notes = (
        ()
        if any(transforms.values())
        else ("neither sform nor qform is set: voxels have their sizes, and no place in a body",)
    )
    details = {
        "dtype": str(dtype),
        "slope": slope,
        "intercept": intercept,
        **transforms,
        "orientation": "".join(code or "?" for code in nibabel.aff2axcodes(affine))
        if np.isfinite(affine).all()
        else "?",
    }
    volume = Volume(
        path,
        "nifti",
        sizes[:3],  # type: ignore[arg-type]
        kept,
        Slices(stream, kept),
        tuple(map(tuple, affine[:3, :3].tolist())),
        tuple(affine[:3, 3].tolist()),
        "right-anterior-superior" if any(transforms.values()) else "the file's own",
        unit_of(_UNITS.get(units, "" if units == "unknown" else units)),
        is_labels="intent_code" in header and int(header["intent_code"]) == LABELS,
        warnings=(*notes, *check_length(stream)),
        details=details,
        files=tuple(dict.fromkeys((path, file))),
    )
    return checked(volume, choice)


def _encoding(file: str) -> str:
    """By the first bytes, for names lie."""
    with open(Path(file), "rb") as opened:
        begin = opened.read(3)
    return "gzip" if begin[:2] == b"\x1f\x8b" else "bzip2" if begin == b"BZh" else "raw"
