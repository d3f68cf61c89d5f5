"""Where in a folder or an archive a scan lies: a workspace any number of folders down, or the one file of points."""

from __future__ import annotations

import re
from dataclasses import dataclass

from pipeline.readers.files.members import Members
from pipeline.readers.files.spelling import shown
from storage.errors import InvalidScan

POINTS = "fused.ply"
_MODEL = re.compile(r"^(?P<folder>(?:.*/)?)(?P<part>cameras|images)\.(?P<ending>bin|txt)$", re.IGNORECASE)
_TRANSFORMS = "transforms.json"
_NOTES = (".txt", ".csv", ".asc")


@dataclass(frozen=True)
class Workspace:
    """`root` ends with "/" or is ""; the others are names below it."""

    root: str
    points: str | None  # None where there are none, or several: see `no_points`
    clouds: tuple[str, ...]
    models: tuple[str, ...]  # folders with cameras and images of the same ending, "" for the root
    transforms: str | None = None

    def no_points(self, members: Members) -> InvalidScan:
        """The error of a workspace without points; `members` are those below its root."""
        if not self.clouds:
            hint = "COLMAP's stereo_fusion writes it"
            return InvalidScan(shown(members.label(POINTS)), "missing", "a dense workspace with fused.ply", hint)
        found = f"{len(self.clouds)} files of points: {', '.join(map(shown, self.clouds[:8]))}"
        return InvalidScan(shown(members.label(POINTS)), found, "fused.ply, or one .ply")


def _model_folders(names: set[str]) -> dict[str, set[str]]:
    """Folders with "/" at their end, and which endings their models have."""
    parts: dict[tuple[str, str], set[str]] = {}
    for name in names:
        if found := _MODEL.match(name):
            parts.setdefault((found["folder"], found["ending"].lower()), set()).add(found["part"].lower())
    folders: dict[str, set[str]] = {}
    for folder, ending in parts:
        folders.setdefault(folder, set()).add(ending)
    return folders


def _depth(root: str) -> int:
    return root.count("/")


def find_workspace(members: Members) -> Workspace | None:
    """The workspace of a scan; None where there is neither a model nor transforms.json.

    Of several the one of the fewest folders down is taken. Raises: InvalidScan where those are several.
    """
    names = members.names.exact
    models = _model_folders(names)
    transforms = {n[: -len(_TRANSFORMS)] for n in names if n.rpartition("/")[2].lower() == _TRANSFORMS}
    dense = {n[: -len(POINTS)] for n in names if n.rpartition("/")[2].lower() == POINTS}
    roots = {root for root in dense if any(m.startswith(root) for m in models)}
    if not roots:
        roots = set(transforms) or {_top_of(m) for m in models}
    if not roots:
        return None
    least = min(map(_depth, roots))
    nearest = sorted(root for root in roots if _depth(root) == least)
    if len(nearest) > 1:
        found = "workspaces " + " and ".join(repr(shown(root)) for root in nearest[:8])
        raise InvalidScan(members.label(""), found, "one workspace", "give the folder of the one that you mean")
    root = nearest[0]
    below = {m[len(root) :] for m in models if m.startswith(root)}
    of_transforms = next((n for n in sorted(names) if n.lower() == (root + _TRANSFORMS).lower()), None)
    clouds = _clouds_of(members, root)
    return Workspace(
        root=root,
        points=clouds[0] if len(clouds) == 1 else None,
        clouds=clouds,
        models=tuple(sorted((m.rstrip("/") for m in below), key=lambda m: (m.count("/"), _natural(m)))),
        transforms=of_transforms[len(root) :] if of_transforms and not below else None,
    )


def _natural(name: str) -> list:
    return [(int(p), "") if p.isdigit() else (-1, p) for p in re.split(r"(\d+)", name)]


def _top_of(model: str) -> str:
    """The folder that holds `sparse/`, of the folder of a model."""
    parts = model.rstrip("/").split("/") if model else []
    at = next((i for i, part in enumerate(parts) if part.lower().startswith("sparse")), len(parts))
    return "".join(f"{part}/" for part in parts[:at])


def _clouds_of(members: Members, root: str) -> tuple[str, ...]:
    """What may be the file of points below the root: fused.ply, else every .ply."""
    below = sorted(n[len(root) :] for n in members.names.exact if n.startswith(root))
    clouds = [n for n in below if n.lower().endswith(".ply")]
    best = [n for n in clouds if n.lower() == POINTS] or [n for n in clouds if n.rpartition("/")[2].lower() == POINTS]
    return tuple(best or [n for n in clouds if "mesh" not in n.lower()])


def find_lone_scan(members: Members, suffixes: tuple[str, ...]) -> str | None:
    """The one file of points of a folder or archive that is no workspace; None where there is none, or several."""
    fitting = [n for n in members.names.exact if n.lower().endswith(suffixes)]
    clouds = [n for n in fitting if not n.lower().endswith(_NOTES)] or (
        fitting if len(members.names.exact) == 1 else []
    )
    return clouds[0] if len(clouds) == 1 else None
