"""What a scan is and what is wrong with it, told from its header."""

from __future__ import annotations

from collections import Counter

from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.detect import open_scan
from pipeline.scan import ScanSource


def summarise(source: ScanSource) -> dict:
    """The header of an opened scan as plain values that JSON can hold."""
    sizes = Counter(f"{c.width_px}x{c.height_px}" for c in source.cameras)
    bounds = source.bounds
    return {
        "path": source.path,
        "format": source.format,
        "points": source.n_points,
        "unit": source.unit,
        "bounds": None if bounds is None else {"min": list(bounds[0]), "max": list(bounds[1])},
        "cameras": {
            "count": len(source.cameras),
            "sizes": dict(sizes),
            "models": source.details.get("camera_models", {"PINHOLE": len(source.cameras)} if source.cameras else {}),
            "names": [c.name for c in source.cameras],
        },
        "stations": [list(s) for s in source.stations],
        "has_normals": source.has_normals,
        "has_colors": source.has_colors,
        "has_intensity": source.has_intensity,
        "has_visibility": source.has_visibility,
        "warnings": list(source.warnings),
        "unused_properties": list(source.unused),
        "details": source.details,
    }


def inspect_scan(path: str, options: ReadOptions = ReadOptions()) -> dict:
    """What `splatpress inspect` prints. Reads headers, not points. Raises as `open_scan`."""
    return summarise(open_scan(path, options))
