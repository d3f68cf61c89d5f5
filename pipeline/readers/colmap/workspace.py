"""A COLMAP dense workspace, as a folder or a .zip: `sparse/`, `images/`, `fused.ply`, `fused.ply.vis`; or nerfstudio's like.

Cameras stand in the order of the model's registered images. A distorted camera is replaced by the pinhole camera that
COLMAP undistorts it to, and its photo is undistorted when it is read. Without `fused.ply.vis` a scan has cameras
but no visibility.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pipeline.readers.attributes.looks import Looks
from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.colmap.fit import best_model
from pipeline.readers.colmap.model import Model, read_model
from pipeline.readers.colmap.photos import Photos, find_photos, read_photo
from pipeline.readers.colmap.transforms import read_transforms
from pipeline.readers.colmap.visibility import VisibilityStream, check_visibility
from pipeline.readers.colmap.visibility_index import visibility_from
from pipeline.readers.files.members import Folder, Members
from pipeline.readers.files.spelling import shown
from pipeline.readers.files.workspaces import POINTS, Workspace
from pipeline.readers.ply.ply import Vertices, at_once, open_vertices, unused_properties
from pipeline.scan import Piece, ScanSource
from storage.errors import InvalidScan, SplatpressError


@dataclass(frozen=True)
class _Opened:
    """All that a workspace's source is made of."""

    path: str
    members: Members
    model: Model
    photos: Photos
    vertices: Vertices
    visibility: str | None  # the member of visibility lists, where they are used
    warnings: tuple[str, ...]


def _open_points(members: Members, name: str) -> Vertices:
    opener = partial(members.open, name)
    return open_vertices(opener, members.size(name), shown(members.label(name)), isinstance(members, Folder))


def _read_models(members: Members, workspace: Workspace, asked: str) -> tuple[list[Model], list[str]]:
    """The models to choose from, and warnings of those that cannot be read.

    Raises: InvalidScan where none can, or where there is none of the folder that was asked for.
    """
    folders = [f for f in workspace.models if not asked or f.lower() == asked.strip("/").lower()]
    if not folders:
        found = f"no model in {asked!r}" if asked else "no COLMAP model"
        allowed = ", ".join(workspace.models) if asked else "cameras and images as .bin or .txt in sparse/"
        hint = "" if asked else "a dense workspace is what COLMAP's image_undistorter and stereo_fusion write"
        raise InvalidScan(shown(members.label("sparse")), found, allowed, hint)
    models, errors = [], []
    for folder in folders:
        try:
            models.append(read_model(members, folder))
        except SplatpressError as error:
            errors.append(error)
    if not models:
        raise errors[0]
    return models, [f"a model is not used: {error}" for error in errors]


def _usable_visibility(members: Members, points: str, n_points: int) -> tuple[str | None, list[str]]:
    """The member of visibility lists that fit the points, else why they are not used."""
    found = members.names.find(points + ".vis")
    by_depth = "what each camera sees will come from a depth test"
    if not found:
        return None, [f"{shown(members.label(points + '.vis'))}: missing; {by_depth}"]
    try:
        with members.open(found[0]) as stream:
            check_visibility(stream, members.size(found[0]), n_points, shown(members.label(found[0])))
    except InvalidScan as error:
        return None, [f"{error}; it is not used, {by_depth} (points were cut or added in another program? delete it)"]
    return found[0], []


def _places(opened: _Opened) -> np.ndarray:  # (n_registered,) int32
    """The camera that each registered photo is; -1 for those that are left out."""
    place = np.full(len(opened.model.photos), -1, np.int32)
    place[[f.place for f in opened.photos.files]] = np.arange(len(opened.photos.files))
    return place


def _slice(opened: _Opened, first: int, stop: int, max_points: int) -> Iterator[Piece]:
    pieces = opened.vertices.slice(first, stop, max_points)
    if opened.visibility is None:
        return pieces
    n_most = at_once(max_points)
    rows = [min(n_most, stop - at) for at in range(first, stop, n_most)]
    path, place = opened.members.label(opened.visibility), _places(opened)
    seen = visibility_from(path, opened.vertices.count, len(place), first, rows)
    kept = (_without_missing(counts, cameras, place) for counts, cameras in seen)
    return (
        replace(p, visible_count=counts, visible_camera=cameras)
        for p, (counts, cameras) in zip(pieces, kept, strict=True)
    )


def _pieces_seen(opened: _Opened, max_points: int) -> Iterator[Piece]:
    members, name, place = opened.members, opened.visibility, _places(opened)
    n_registered = len(place)
    with members.open(name) as stream:
        visibility = VisibilityStream(stream, n_registered, shown(members.label(name)))
        for piece in opened.vertices.pieces(max_points):
            counts, cameras = _without_missing(*visibility.take(len(piece.position)), place)
            yield replace(piece, visible_count=counts, visible_camera=cameras)
        visibility.finish()


def _without_missing(counts: np.ndarray, cameras: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Visibility lists of registered photos as lists of cameras, which stand at `place`, without those at -1."""
    if (place >= 0).all():  # then each stands where it is registered
        return counts, cameras
    cameras = place[cameras]
    there = cameras >= 0
    owner = np.repeat(np.arange(len(counts)), counts)[there]
    return np.bincount(owner, minlength=len(counts)), cameras[there]


def open_workspace(path: str, members: Members, workspace: Workspace, options: ReadOptions) -> ScanSource:
    """A dense workspace that lies in `members`.

    Guarantees: a folder and its .zip give the same cameras, points and photos; nothing is left unpacked on disk.
    Raises: InvalidScan naming the file and what is wrong with it; UnsupportedScan for a camera model by name.
    """
    members = members.below(workspace.root)
    points = workspace.points
    warnings: list[str] = []
    if workspace.transforms:
        model, named = read_transforms(members, workspace.transforms)
        points, models = _named_points(members, named) or points, [model]
    else:
        models, warnings = _read_models(members, workspace, options.sparse_model)
    if points is None:
        raise workspace.no_points(members)
    if points.rpartition("/")[2].lower() != POINTS and not workspace.transforms:
        warnings.append(f"{shown(members.label(points))} is taken for the points, as there is no {POINTS}")
    vertices = _open_points(members, points)
    if len(models) > 1 and vertices.count:
        fit, said = best_model(members, models, vertices)
        model, photos, warnings = fit.model, fit.photos, [*warnings, *said]
    else:
        model = models[0]
        photos = find_photos(members, model.photos)
    visibility, said = _usable_visibility(members, points, vertices.count)
    warnings += [*said, *model.warnings, *photos.warnings]
    return _source(_Opened(path, members, model, photos, vertices, visibility, tuple(warnings)))


def _named_points(members: Members, named: str | None) -> str | None:
    found = members.names.find(named.removeprefix("./")) if named else ()
    return found[0] if len(found) == 1 else None


def _source(opened: _Opened) -> ScanSource:
    vertices, cameras = opened.vertices, opened.photos.cameras
    return ScanSource(
        path=opened.path,
        format="colmap",
        n_points=vertices.count,
        pieces=partial(_pieces_seen, opened) if opened.visibility else vertices.pieces,
        read_slice=partial(_slice, opened) if isinstance(opened.members, Folder) and vertices.has_slices else None,
        settle=partial(_settled, opened) if vertices.is_sample else None,
        cameras=cameras,
        read_photo=partial(read_photo, opened.members, opened.photos.files),
        has_normals=bool(vertices.columns.normal),
        has_colors=vertices.has_colors,
        has_intensity=vertices.decision.intensity,
        has_visibility=opened.visibility is not None,
        position_type=vertices.position_type,
        is_single=vertices.is_single,
        warnings=(*vertices.warnings, *opened.warnings),
        unused=unused_properties(vertices),
        details={
            "model": shown(opened.model.folder),
            "camera_models": dict(Counter(f.photo.model for f in opened.photos.files)),
            "comments": list(vertices.header.comments),
            "properties": [p.name for p in vertices.header.vertex.properties],
        },
    )


def _settled(opened: _Opened, looks: Looks) -> ScanSource | None:
    settled = opened.vertices.settled(looks)
    return settled and _source(replace(opened, vertices=settled))  # type: ignore[return-value]
