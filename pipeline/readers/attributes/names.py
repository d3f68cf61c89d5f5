"""What the properties of a point are called: one table for PLY, PCD, LAS extra bytes, E57 extensions and columns of text.

Names are compared without case, separators, namespaces (`nor:`) and prefixes that say no more than "a number of a point"
(`scalar_`, CloudCompare's). A set of three is used whole or not at all.

References: the names that CloudCompare, PDAL, OpenMVS, MeshLab, PCL, Metashape, libE57 extensions and 3D Gaussian Splatting write.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

_POSITION = (("x", "y", "z"), ("cartesianx", "cartesiany", "cartesianz"), ("posx", "posy", "posz"), ("px", "py", "pz"))
_NORMAL = (
    ("nx", "ny", "nz"),
    ("normalx", "normaly", "normalz"),
    ("normalsx", "normalsy", "normalsz"),
    ("normx", "normy", "normz"),
    ("normal0", "normal1", "normal2"),
)
_COLOR = (
    ("red", "green", "blue"),
    ("diffusered", "diffusegreen", "diffuseblue"),
    ("colorred", "colorgreen", "colorblue"),
    ("r", "g", "b"),
    ("colorr", "colorg", "colorb"),
    ("vertexcolorr", "vertexcolorg", "vertexcolorb"),
    ("rf", "gf", "bf"),
)
_HARMONIC = (("fdc0", "fdc1", "fdc2"),)
_INTENSITY = (
    ("intensity",),
    ("reflectance",),
    ("reflectivity",),
    ("remission",),
    ("amplitude",),
    ("gray",),
    ("grey",),
    ("luminance",),
    ("i",),
)
# The constant term of the spherical harmonics that 3D Gaussian Splatting keeps colours in: colour = 0.5 + HARMONIC * f_dc.
HARMONIC = 0.28209479177387814

_PREFIX = re.compile(r"^(scalar|vertex|point|attr)[ _-]+")


@dataclass(frozen=True)
class Columns:
    """Which properties hold what; empty where there is none. Names are those of the file."""

    position: tuple[str, ...] = ()
    normal: tuple[str, ...] = ()
    color: tuple[str, ...] = ()
    harmonic: tuple[str, ...] = ()  # colours as 3D Gaussian Splatting's f_dc; used where `color` is empty
    intensity: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()


def plain(name: str) -> str:
    """The name as the table has it.

    >>> [plain(n) for n in ("nor:normalX", "scalar_Intensity", "diffuse_red", "f_dc_0", "Normal X")]
    ['normalx', 'intensity', 'diffusered', 'fdc0', 'normalx']
    """
    name = name.strip().lower().rpartition(":")[2]
    return re.sub(r"[ _./-]+", "", _PREFIX.sub("", name))


def columns_of(names: Iterable[str]) -> Columns:
    """Who is who among the property names of a file.

    Guarantees: of several sets that mean the same the one that stands first in the table is taken, a name as it stands
    there before one with a prefix; every name that is not taken is in `unused`, in the file's order.
    """
    names = tuple(names)
    known: dict[str, str] = {}
    for name in sorted(names, key=lambda n: plain(n) != n):  # as it stands in the table first
        known.setdefault(plain(name), name)

    def first(sets: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
        found = next((s for s in sets if all(n in known for n in s)), ())
        return tuple(known[n] for n in found)

    position, normal, color = first(_POSITION), first(_NORMAL), first(_COLOR)
    harmonic = () if color else first(_HARMONIC)
    # Stanford's range scans carry `intensity` beside `confidence`; it is no brightness that one would want to see.
    intensity = () if "confidence" in known else first(_INTENSITY)
    taken = {*position, *normal, *color, *harmonic, *intensity}
    return Columns(position, normal, color, harmonic, intensity, tuple(n for n in names if n not in taken))
