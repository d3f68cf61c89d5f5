"""Packed files of one scan side by side: what each costs to draw and to keep, and how near it comes to the
photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

from pipeline.effects.exposure.photographs import read_photo
from renderer.evaluate.compare import difference, fullest_square, psnr_db
from renderer.evaluate.previews import even_choice, limited_view, safe_names
from renderer.pictures import resized, save_picture
from renderer.report.report import sizes_of
from renderer.splats.renderer import Picture, Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.views import orbit_views
from storage.packed.packed import PackedFile
from storage.packed.schema import Camera

N_VIEWS, MAX_SIDE_PX, ORBIT_PX = 4, 1024, (960, 720)
ROUNDS = 5  # every variant is drawn once a round, so that a machine's mood falls on all alike
SPOT_PX, ENLARGED = 120, 4


@dataclass(frozen=True)
class EffectsVariant:
    """A packed file under a name, and the folder of the photographs that it was textured from."""

    name: str
    packed: Path
    photos: Path


def compare_variants(variants: Sequence[EffectsVariant], folder: Path | None = None) -> list[dict]:
    """A row a variant: `frame_s` (median over views of the best of ROUNDS), `frame_ratio` (median over views and rounds
    of a frame's time against the first variant's of the same round), `gpu_bytes`, `file_bytes`, `psnr_vs_photos_db`
    (mean over views, over the pixels that all variants cover; each against the photographs as it was textured from
    them), `psnr_vs_first_db` (against the first variant's picture) and the `programs` that drew it. None without
    photographs. With a `folder` each variant but the first has NAME.png there: where it differs most from the first
    one, itself, the first one and, if there is one, the photograph as the first was textured from it, side by side."""
    renderer = Renderer()
    scenes = []
    for variant in variants:
        with PackedFile(variant.packed) as packed:
            scenes.append(GpuScene(packed.load(), renderer.context))
    cameras = scenes[0].scene.header.cameras
    chosen = even_choice(len(cameras), N_VIEWS)
    views = [limited_view(cameras[i], MAX_SIDE_PX) for i in chosen] or orbit_views(scenes[0].scene, N_VIEWS, ORBIT_PX)
    seconds: list[list[float]] = [[] for _ in variants]
    ratios: list[list[float]] = [[] for _ in variants]
    spots: list[tuple] = [(-1.0, None)] * len(variants)
    figures: list[dict[str, list]] = [{"psnr_vs_photos_db": [], "psnr_vs_first_db": []} for _ in variants]
    programs: list[set[str]] = [set() for _ in variants]
    for scene in scenes:
        renderer.render(
            scene, views[0]
        )  # compiles; at no other size, or splats that are small there would call for wide sums
    for i, view in enumerate(views):
        pictures, taken = _rounds(renderer, scenes, view)
        covered = np.logical_and.reduce([picture.coverage for picture in pictures])
        for k, picture in enumerate(pictures):
            off, row, column = fullest_square(difference(picture.rgb, pictures[0].rgb, covered), SPOT_PX)
            at = slice(row, row + SPOT_PX), slice(column, column + SPOT_PX)
            spots[k] = max(spots[k], (off, (i, at)), key=lambda spot: spot[0])
            seconds[k].append(min(taken[k]))
            ratios[k] += [here / first for here, first in zip(taken[k], taken[0], strict=True)]
            programs[k] |= set(picture.programs)
            figures[k]["psnr_vs_first_db"].append(psnr_db(picture.rgb, pictures[0].rgb, covered))
            if chosen:
                photo = resized(read_photo(variants[k].photos, chosen[i]), view.width_px, view.height_px)
                figures[k]["psnr_vs_photos_db"].append(psnr_db(picture.rgb, photo, covered))
    rows = [
        {
            "variant": variant.name,
            "frame_s": median(seconds[k]),
            "frame_ratio": median(ratios[k]),
            "file_bytes": variant.packed.stat().st_size,
            "gpu_bytes": sizes_of(scenes[k].scene, 0).gpu_bytes,
            **{name: _mean(values) for name, values in figures[k].items()},
            "programs": sorted(programs[k]),
        }
        for k, variant in enumerate(variants)
    ]
    for k in range(1, len(variants) if folder else 0):
        _, (i, at) = spots[k]
        shown = [renderer.render(scenes[n], views[i]).rgb for n in (k, 0)]
        if chosen:
            photo = read_photo(variants[0].photos, chosen[i])
            shown.append(resized(photo, views[i].width_px, views[i].height_px))
        save_picture(folder / f"{safe_names([variants[k].name])[0]}.png", _enlarged(shown, at))
    for scene in scenes:
        scene.release()
    return rows


def _enlarged(pictures: list[np.ndarray], at: tuple[slice, slice]) -> np.ndarray:
    return np.concatenate(
        [np.repeat(np.repeat(rgb[at], ENLARGED, axis=0), ENLARGED, axis=1) for rgb in pictures], axis=1
    )


def _rounds(renderer: Renderer, scenes: list[GpuScene], view: Camera) -> tuple[list[Picture], list[list[float]]]:
    """The picture of each scene, and the seconds of its frames, round by round."""
    taken: list[list[float]] = [[] for _ in scenes]
    pictures: list[Picture | None] = [None] * len(scenes)
    for _ in range(ROUNDS):
        for k, scene in enumerate(scenes):
            pictures[k] = renderer.render(scene, view)
            taken[k].append(sum(pictures[k].pass_seconds.values()))
    return pictures, taken


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if known else None
