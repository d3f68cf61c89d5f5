"""A packed file as what others open: points, Gaussians or a page. Each format says what it loses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.exports import glb, las, ply, sog, spz, tiles
from pipeline.exports.cloud import Cloud, backed, cloud_of, samples_of
from pipeline.exports.formats import AUTO, FIT_STEPS, FORMATS, GAUSSIANS, PACKED, PAGE, POINTS, TILES
from pipeline.exports.gaussians import Gaussians, gaussians_of, to_y_up, turned
from pipeline.splats.decoded import scene_radii
from renderer.evaluate.own_colours import MOST_FITTED, in_own_colours, views_of
from renderer.splats.detail import parents_of
from renderer.splats.views import up_direction
from services.web.viewer_page import one_page
from storage.errors import UnsupportedScan
from storage.maps import NO_MAP
from storage.packed.dictionaries.shipped import file_of
from storage.packed.packed import PackedFile, PackedScene
from storage.packed.schema import Header
from storage.whole import whole

SAMPLED = (POINTS, GAUSSIANS, TILES)  # kinds that may have more than one for a splat
LEAST_CONTRAST = 4 / 255  # by which samples of a splat differ from their mean in a channel where it is four Gaussians
LIGHTER = "; --samples 1 --fit 0 writes one each, in less time and less like the file"
METRES = {"metre": 1.0, "foot": 0.3048, "US survey foot": 1200 / 3937}


@contextmanager
def viewed(packed: Path, is_archive: bool) -> Iterator[Path]:
    """The packed file in the form that the viewer reads: itself, or its plain form for as long as this lasts."""
    if not is_archive:
        yield packed
        return
    from storage.packed.archive.transcode import plain_packed  # compiles loops: for archives alone

    with TemporaryDirectory(prefix="splatpress-") as folder:
        plain = Path(folder) / packed.name
        plain_packed(packed, plain)
        yield plain


@dataclass(frozen=True)
class Exported:
    """What was written and what it lost, in words."""

    format: str
    path: Path
    n_bytes: int
    n_elements: int  # points or Gaussians
    lost: tuple[str, ...]


def export(packed: Path, format: str, out: Path, samples: str = AUTO, fit: int = FIT_STEPS) -> Exported:
    """Write `packed` as one of FORMATS to the path `out`, which appears when it is whole.

    `samples` of SAMPLES: points or Gaussians a splat; AUTO is one point, or four Gaussians where the texture has
    contrast and one elsewhere, and another behind each whose colours are fitted. `fit`: steps that colours of Gaussians
    are fitted by to pictures of the file, 0 for none.

    Raises: UnsupportedScan for a format that is unknown, or that is no list of points or Gaussians where `samples` asks
    for more of them, or for a file without atoms.
    """
    if format not in FORMATS:
        raise UnsupportedScan("export", f"format {format!r}", ", ".join(FORMATS))
    chosen = FORMATS[format]
    more = samples not in (AUTO, "1")
    if more and chosen.kind not in SAMPLED:
        raise UnsupportedScan(
            "export",
            f"{format} with textures as more points",
            ", ".join(name for name, known in FORMATS.items() if known.kind in SAMPLED),
        )
    with PackedFile(packed) as opened:
        if chosen.kind == PAGE:
            return _page(packed, opened, format, out)
        if chosen.kind == PACKED:
            return _packed(packed, opened.header, format, out)
        scene = opened.load()
    if more and not scene.header.n_dictionary:
        raise UnsupportedScan(
            "export", f"textures as more points of {packed}, which has no atoms", "points without textures"
        )
    splats = cloud_of(scene, all_levels=chosen.kind == TILES)
    cloud, too_many = sampled(scene, splats, chosen.kind, samples, fit)
    lost = _lost_by_all(scene, splats, cloud, chosen.kind) + too_many
    elements: Cloud | Gaussians = cloud
    if chosen.kind != POINTS:
        elements, blending = in_own_colours(scene, gaussians_of(cloud), fit)
        lost += blending
    out.parent.mkdir(parents=True, exist_ok=True)
    with whole(out, suffix=chosen.suffix) as partial:
        lost += _WRITERS[format](partial, elements, scene)
    return Exported(format, out, out.stat().st_size, len(cloud), lost)


def sampled(scene: PackedScene, splats: Cloud, kind: str, samples: str, fit: int) -> tuple[Cloud, tuple[str, ...]]:
    """Points, or what Gaussians are made of; of a file that would have more than MOST_FITTED each splat is one, where
    nothing was asked for, and the second says so."""
    if samples == "1" or not scene.header.n_dictionary or (samples == AUTO and kind == POINTS):
        return splats, ()
    if samples != AUTO:
        return samples_of(scene, splats, int(samples)), ()
    divided = samples_of(scene, splats, 4, LEAST_CONTRAST)
    if fit and views_of(scene):
        divided = backed(divided, splats)
    if len(divided) > MOST_FITTED:
        return splats, (f"more than one Gaussian a splat: {len(divided):,} would be more than {MOST_FITTED:,}",)
    return divided, ()


def _packed(packed: Path, header: Header, format: str, out: Path) -> Exported:
    """All of the file, in another form."""
    from storage.packed.archive.transcode import archive_packed, plain_packed  # compiles loops: for archives alone

    (archive_packed if format == "archive" else plain_packed)(packed, out)
    return Exported(format, out, out.stat().st_size, header.n_finest, ())


def _page(packed: Path, opened: PackedFile, format: str, out: Path) -> Exported:
    """All of the file, in the form that the viewer reads."""
    header = opened.header
    name = header.scan.get("name")
    with viewed(packed, opened.is_archive) as path:
        atoms = file_of(header.shipped).read_bytes() if header.shipped else b""
        data = one_page(path.read_bytes(), name if isinstance(name, str) else packed.stem, atoms)
    out.parent.mkdir(parents=True, exist_ok=True)
    with whole(out) as partial:
        partial.write_bytes(data)
    return Exported(format, out, len(data), header.n_finest, ())


def _lost_by_all(scene: PackedScene, splats: Cloud, cloud: Cloud, kind: str) -> tuple[str, ...]:
    n, lost = len(splats), []
    first = 0 if kind == TILES else scene.header.first_finest
    n_lines = int((scene.rows.clipline[first:] >= 0).sum())
    if first:
        lost.append(f"coarser levels of detail, {first:,} splats")
    if scene.header.n_dictionary:
        n_textured = int((scene.n_atoms[first:] > 0).sum())
        lost.append(
            f"textures of {n_textured:,} of {n:,} splats: "
            + (f"{len(cloud):,} samples of them" if len(cloud) > n else "each has the one colour of its patch's middle")
        )
    if scene.header.maps:
        n_mapped = int((scene.arrays["station"][first:] != NO_MAP).sum())
        lost.append(
            f"textures of {n_mapped:,} of {n:,} splats, looked up in {len(scene.header.maps)} maps of stations: "
            "each has the one colour of its point"
        )
    if n_lines:
        lost.append(f"cliplines of {n_lines:,} splats: they are whole")
    n_solid = int(splats.solid.sum())
    if n_solid and kind == POINTS:
        lost.append(f"shapes of {n_solid:,} ellipsoids: points with their longest half axis as radius")
    if kind != POINTS:
        lost.append(
            f"compactness: {len(cloud) / max(n, 1):.2g} Gaussians a splat" + (LIGHTER if len(cloud) > n else "")
        )
        lost.append("the blending of surfaces within a depth margin: Gaussians are sorted and laid over each other")
    if scene.header.cameras:
        lost.append(f"{len(scene.header.cameras)} cameras, and which splat was textured from which")
    return tuple(lost)


def _error_of(largest: float, header: Header) -> str:
    unit = "" if header.unit == "unknown" else f" {header.unit}"
    return f"coordinates to within {largest:.2g}{unit}, {largest / header.radius:.2g} of a splat's radius"


def _against_origin(header: Header) -> tuple[str, ...]:
    if not any(header.origin):
        return ()
    return (f"large coordinates: positions are against the origin {', '.join(f'{x:.10g}' for x in header.origin)}",)


def _comments(header: Header) -> Sequence[str]:
    return ["made by splatpress", f"unit {header.unit}"]


def _write_ply(path: Path, cloud: Cloud, scene: PackedScene) -> tuple[str, ...]:
    ply.write_points(path, cloud, _comments(scene.header))
    return ()


def _write_las(path: Path, cloud: Cloud, scene: PackedScene) -> tuple[str, ...]:
    largest = las.write(path, cloud)
    return (_error_of(largest, scene.header), "the name of the coordinate system, which packed files do not keep")


def _write_gaussian_ply(path: Path, gaussians: Gaussians, scene: PackedScene) -> tuple[str, ...]:
    ply.write_gaussians(path, gaussians, _comments(scene.header))
    return _against_origin(scene.header)


def _write_spz(path: Path, gaussians: Gaussians, scene: PackedScene) -> tuple[str, ...]:
    largest = spz.write(path, turned(gaussians, _y_up(scene.header)))
    return (
        *_against_origin(scene.header),
        "the scan's axes: turned so that y is up",
        _error_of(largest, scene.header),
        "colours to within 0.94 of 255",
    )


def _write_sog(path: Path, gaussians: Gaussians, scene: PackedScene) -> tuple[str, ...]:
    largest = sog.write(path, gaussians)
    return (*_against_origin(scene.header), _error_of(largest, scene.header))


def _write_glb(path: Path, gaussians: Gaussians, scene: PackedScene) -> tuple[str, ...]:
    glb.write(path, gaussians, _y_up(scene.header), METRES.get(scene.header.unit, 1.0), scene.header.unit)
    return _against_origin(scene.header)


def _write_tiles(path: Path, gaussians: Gaussians, scene: PackedScene) -> tuple[str, ...]:
    parent = parents_of(scene.header.levels or (scene.header.n_splats,))
    radius = scene_radii(scene)
    tiles.write(
        path, gaussians, radius, parent, _y_up(scene.header), METRES.get(scene.header.unit, 1.0), scene.header.unit
    )
    return (*_against_origin(scene.header), "a place on the globe: tiles stand about the origin, z up, in metres")


def _y_up(header: Header) -> Rotation:
    return to_y_up(np.asarray(up_direction(header)))


_WRITERS: dict[str, Callable[[Path, Any, PackedScene], tuple[str, ...]]] = {  # each returns what it alone loses
    "ply": _write_ply,
    "las": _write_las,
    "laz": _write_las,
    "3dgs-ply": _write_gaussian_ply,
    "spz": _write_spz,
    "sog": _write_sog,
    "glb": _write_glb,
    "3dtiles": _write_tiles,
}
