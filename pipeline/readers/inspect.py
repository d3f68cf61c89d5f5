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
        "lacks": lacks(source),
        "unused_properties": list(source.unused),
        "details": source.details,
    }


def lacks(source: ScanSource) -> list[str]:
    """What a scan does not have that its picture would gain by, and what is done instead."""
    found = []
    if not source.has_normals:
        side = "turned up" if source.format == "las" else "and neighbours agree which side is out"
        side = "turned to their cameras" if source.cameras else "turned to their stations" if source.stations else side
        found.append(f"no normals: estimated from each point's neighbours, {side}")
    if not (source.cameras or source.has_colors or source.has_intensity):
        found.append("no photographs, colours or intensity: splats are grey, shaded by their normals")
    elif not source.cameras and source.has_colors:
        textured = "; --density 0.1 textures fewer of them from the others" if source.stations else ""
        found.append(f"no photographs: each splat has one colour, the point's own{textured}")
    elif not source.cameras:
        found.append("no photographs or colours: each splat has one grey, of the point's intensity")
    elif not source.has_visibility:
        found.append("no lists of what each photograph sees (fused.ply.vis): a depth test tells")
    return found


def inspect_scan(path: str, options: ReadOptions = ReadOptions()) -> dict:
    """What `splatpress inspect` prints. Reads headers, not points. Raises as `open_scan`."""
    return summarise(open_scan(path, options))
