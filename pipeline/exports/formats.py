"""The formats that others open, by name. Light: the command line and the API read it without the encoders."""

from __future__ import annotations

from dataclasses import dataclass

POINTS, GAUSSIANS, TILES, PAGE = "points", "Gaussians", "Gaussians of all levels", "splats"
PACKED = "packed splats"
AUTO = "auto"
SAMPLES = (AUTO, "1", "4", "12")  # points or Gaussians a splat
FIT_STEPS = (
    3  # that colours of Gaussians are fitted by: more fit the pictures given, and others hardly (docs/EXPORTS.md)
)


@dataclass(frozen=True)
class Format:
    """A format that packed files are exported to: what its files are called, consist of, and are good for."""

    suffix: str
    kind: str  # what it consists of
    media_type: str
    about: str


FORMATS: dict[str, Format] = {
    "ply": Format(".ply", POINTS, "application/octet-stream", "positions as double, normals, colours, radii"),
    "las": Format(".las", POINTS, "application/vnd.las", "for GIS; normals and radii as extra dimensions"),
    "laz": Format(".laz", POINTS, "application/vnd.laszip", "the same, compressed"),
    "3dgs-ply": Format(".3dgs.ply", GAUSSIANS, "application/octet-stream", "as 3DGS trainers write them"),
    "spz": Format(".spz", GAUSSIANS, "application/octet-stream", "the same, small"),
    "sog": Format(".sog", GAUSSIANS, "application/zip", "the same, smaller, for SuperSplat and PlayCanvas"),
    "html": Format(".html", PAGE, "text/html", "the viewer and the file in one page, which opens offline"),
    "glb": Format(
        ".glb", GAUSSIANS, "model/gltf-binary", "glTF with KHR_gaussian_splatting; points to programs without it"
    ),
    "3dtiles": Format(
        ".3dtiles.zip", TILES, "application/zip", "a zip of tileset.json and such a GLB a group of splats, with levels"
    ),
    "archive": Format(
        ".archive.splatpress", PACKED, "application/octet-stream", "the packed file in archive form, a quarter smaller"
    ),
    "plain": Format(
        ".plain.splatpress", PACKED, "application/octet-stream", "the packed file in plain form, as viewers take it"
    ),
}
