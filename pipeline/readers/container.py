"""A folder or a .zip: a workspace any number of folders down, or one file of points beside whatever else."""

from __future__ import annotations

import os
from functools import partial

from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.files.members import Folder, Members, open_archive
from pipeline.readers.files.spelling import shown
from pipeline.readers.files.workspaces import find_lone_scan, find_workspace
from pipeline.readers.points import READERS, open_points, opened_anew
from pipeline.scan import ScanSource
from storage.errors import InvalidScan


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
            return open_points(members.label(lone), options)
        return opened_anew(partial(members.local, lone), shown(members.label(lone)), options)
    raise InvalidScan(shown(members.label("sparse")), *_nothing(members))


def _nothing(members: Members) -> tuple[str, str, str]:
    names = sorted(members.names.exact)
    clouds = [n for n in names if n.lower().endswith(tuple(READERS))]
    what = f"{len(clouds)} files of points" if clouds else f"{len(names)} files"
    listed = ", ".join(map(shown, (clouds or names)[:5]))
    hint = "a dense workspace is what COLMAP's image_undistorter and stereo_fusion write"
    allowed = "cameras and images as .bin or .txt in sparse/, or one file of points"
    return f"no COLMAP model in {what} ({listed})", allowed, hint
