"""`path record`: a path for `fly`, from photographs' poses, from poses of a file, or one of the four of the paper."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from renderer.files import write_json
from renderer.residency.paths import NAMES, Path90, path_json, pose_of, read_path, through
from services.processes.pages.table import four_paths, places_with_photographs
from storage.errors import InvalidScan
from storage.packed.packed import PackedFile

PHOTOGRAPHS = "photographs"
KINDS = (*NAMES, PHOTOGRAPHS)


def record(packed: Path, kind: str, seconds: float, out: Path) -> Path90:
    """Write the path of `kind` (one of KINDS), or through the poses of the path file of that name, into `out`.

    Raises: InvalidScan for a packed file without photographs, for fewer than two of them, and for a file of poses that
    is none.
    """
    with PackedFile(packed) as opened:
        scene = opened.load()
    if kind in NAMES:
        path = four_paths(scene, places_with_photographs(packed, scene)[0])[0][kind]
    else:
        keys = tuple(pose_of(c) for c in scene.header.cameras) if kind == PHOTOGRAPHS else read_path(Path(kind)).poses
        if len(keys) < 2:
            raise InvalidScan(
                str(packed), f"{len(keys)} photographs", "a packed file with 2 or more, for a path through them"
            )
        path = through(kind if kind == PHOTOGRAPHS else Path(kind).stem, keys, seconds)
    write_json(out, path_json(path))
    return replace(path, name=out.stem)
