"""A folder or a .zip: a workspace any number of folders down, or one file of points beside whatever else."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial

from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.files.members import Folder, Members, open_archive
from pipeline.readers.files.spelling import shown
from pipeline.readers.files.workspaces import find_lone_scan, find_workspace
from pipeline.readers.points import READERS, open_points, opened_anew
from pipeline.scan import ScanSource
from storage.errors import InvalidScan

PHOTOS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".heic", ".bmp", ".dng")
_PROGRAMS = {
    "sfm_data.json": "OpenMVG",
    "sfm_data.bin": "OpenMVG",
    "cameras.xml": "Metashape",
    "doc.xml": "Metashape",
    "bundle.out": "Bundler",
    "reconstruction.json": "OpenSfM",
    "cameras.sfm": "Meshroom",
}
_SUFFIXES = {".psx": "Metashape", ".mvs": "OpenMVS", ".nvm": "VisualSFM", ".rcproj": "RealityScan"}


def open_container(path: str, options: ReadOptions) -> ScanSource:
    """The scan in a folder or an archive.

    Raises: InvalidScan where there is none, or where several are; and what their readers raise.
    """
    members = Folder(path) if os.path.isdir(path) else open_archive(path)
    if workspace := find_workspace(members):
        from pipeline.readers.colmap.workspace import open_workspace  # pycolmap takes half a second to import

        return open_workspace(shown(path), members, workspace, options)
    if lone := find_lone_scan(members, tuple(READERS)):
        if isinstance(members, Folder):
            source = open_points(members.label(lone), options)
        else:
            source = opened_anew(partial(members.local, lone), shown(members.label(lone)), options)
        return replace(source, warnings=(*_beside(shown(path), members, lone), *source.warnings))
    raise InvalidScan(shown(members.label("sparse")), *_nothing(members))


def _beside(path: str, members: Members, lone: str) -> list[str]:
    """What lies beside the one file of points that would be used with cameras that are known."""
    names = sorted(members.names.exact)
    photos = [n for n in names if n.lower().endswith(PHOTOS)]
    programs = sorted({program for n in names if (program := _PROGRAMS.get(n.rpartition("/")[2].lower()))})
    programs += sorted({_SUFFIXES[s] for n in names if (s := os.path.splitext(n)[1].lower()) in _SUFFIXES})
    if not photos and not programs:
        return []
    what = [f"{len(photos)} photograph{'s' * (len(photos) != 1)}"] * bool(photos)
    what += [f"cameras of {', '.join(programs)}"] * bool(programs)
    why = "there is no COLMAP model and no transforms.json" + "; export them as COLMAP" * bool(programs)
    return [f"{path}: not used beside {shown(lone)}: {' and '.join(what)} ({why})"]


def _nothing(members: Members) -> tuple[str, str, str]:
    names = sorted(members.names.exact)
    clouds = [n for n in names if n.lower().endswith(tuple(READERS))]
    what = f"{len(clouds)} files of points" if clouds else f"{len(names)} files"
    listed = ", ".join(map(shown, (clouds or names)[:5]))
    hint = "a dense workspace is what COLMAP's image_undistorter and stereo_fusion write"
    allowed = "cameras and images as .bin or .txt in sparse/, or one file of points"
    return f"no COLMAP model in {what} ({listed})", allowed, hint
