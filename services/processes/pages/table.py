"""`fly --table`: Table 1 of the 2020 paper on any packed file with photographs, in simulated time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from renderer.residency.paths import NAMES, Path90, made_paths
from renderer.residency.places import Places
from renderer.residency.prediction import PREDICTIONS
from renderer.residency.scene import scene_places
from renderer.residency.simulate import BUDGETS, Row, rows_of_path
from renderer.splats.views import up_direction
from storage.errors import InvalidScan
from storage.packed.packed import PackedFile
from storage.packed.scene import PackedScene

MAGNIFIED = 4  # photographs as wide again, as the paper's 32k set: those of test scans fit any pool


def table_of(
    packed: Path,
    magnified: int = MAGNIFIED,
    budgets: tuple[tuple[int, int], ...] = BUDGETS,
    on_path: Callable[[str], None] = lambda name: None,
    cold: bool = False,
) -> dict:
    """Misses by pixels relative to no prediction under `misses`, by pages under `misses_by_pages`, of the default
    policy and the first budget; under `rows`
    those of both policies, all budgets, by pixels and pages; with `cold` besides those of a viewer who comes in at
    once.

    Guarantees: the same file gives the same table, digit for digit.
    Raises: InvalidScan for a packed file without photographs.
    """
    with PackedFile(packed) as opened:
        scene = opened.load()
    places, _ = places_with_photographs(packed, scene, magnified)
    paths, distance = four_paths(scene, places)
    rows: list[Row] = []
    for name in NAMES:
        on_path(name)
        rows += rows_of_path(places, paths[name], distance, budgets, (False, True) if cold else (False,))
    first = {
        (r.prediction, r.path): r
        for r in rows
        if r.policy == "default" and (r.n_frame, r.n_pool) == budgets[0] and not r.cold
    }
    return {
        "packed": packed.name,
        "magnified": magnified,
        "n_pages": places.layout.n_pages,
        "misses": {p: {name: first[p, name].pixels_of_nothing for name in NAMES} for p in PREDICTIONS},
        "misses_by_pages": {p: {name: first[p, name].pages_of_nothing for name in NAMES} for p in PREDICTIONS},
        "rows": [asdict(row) for row in rows],
    }


def places_with_photographs(
    packed: Path, scene: PackedScene, magnified: int = 1, page_px: int = 128
) -> tuple[Places, np.ndarray]:
    """As `scene_places`. Raises: InvalidScan where there is none."""
    if not scene.header.cameras or "camera" not in scene.arrays:
        raise InvalidScan(str(packed), "no photograph textures its splats", "a packed file of a scan with photographs")
    places, label = scene_places(scene, magnified, page_px)
    if not len(places.centre):
        raise InvalidScan(str(packed), "no splat that a photograph shows", "a packed file of a scan with photographs")
    return places, label


def four_paths(scene: PackedScene, places: Places) -> tuple[dict[str, Path90], float]:
    """The four paths of a scan, before the photograph that most splats are of, and its distance to them."""
    most = int(np.bincount(places.photo).argmax())
    camera = scene.header.cameras[most]
    local = places.centre[places.photo == most] - np.array(camera.centre)
    distance = float(np.median(local @ np.array(camera.rotation)[2]))
    return made_paths(camera, distance, up_direction(scene.header)), distance


def as_text(found: dict) -> str:
    """The table, one block a budget and policy."""
    lines = [
        f"page misses relative to no prediction, by pixels / by pages; photographs {found['magnified']} times as wide"
    ]
    blocks = dict.fromkeys((r["n_frame"], r["n_pool"], r["policy"], r["cold"]) for r in found["rows"])
    for block in blocks:
        n_frame, n_pool, policy, cold = block
        lines += [
            "",
            f"{n_frame} pages a frame, pool of {n_pool}, policy {policy}{', cold' if cold else ''}".ljust(48)
            + "".join(f"{n:>14}" for n in NAMES),
        ]
        rows = {
            (r["prediction"], r["path"]): r
            for r in found["rows"]
            if (r["n_frame"], r["n_pool"], r["policy"], r["cold"]) == block
        }
        for prediction in PREDICTIONS:
            cells = (rows[prediction, name] for name in NAMES)
            lines.append(f"{prediction:<48}" + "".join(f"{_cell(row):>14}" for row in cells))
        nothing = (rows["nothing", name]["misses"] for name in NAMES)
        lines.append(f"{'nothing missed, % of pixels':<48}" + "".join(f"{100 * m['pixels']:>14.3f}" for m in nothing))
    return "\n".join(lines)


def _cell(row: dict) -> str:
    return "/".join("-" if (v := row[k]) is None else f"{v:.2f}" for k in ("pixels_of_nothing", "pages_of_nothing"))
