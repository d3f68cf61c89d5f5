"""What a packed file shows where a photograph was taken that it was made without."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.effects.exposure.photographs import read_photo
from pipeline.effects.exposure.solve import DARKEST
from pipeline.numerics.srgb import linear_of, srgb_of
from renderer.evaluate.compare import flip, psnr_db, ssim
from renderer.evaluate.previews import limited_view, safe_names
from renderer.pictures import resized, save_picture
from renderer.report.evaluation_document import HeldOutView
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.targets import USUAL
from storage.packed.packed import PackedFile

FOLDER = "held-out"
MAX_SIDE_PX = 1600


@dataclass(frozen=True)
class HeldOut:
    """A packed file, the folder of the ingest stage, and the cameras whose photographs textured nothing."""

    packed: Path
    ingest: Path
    cameras: tuple[int, ...]


def matched(rgb: np.ndarray, photo: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A picture (height, width, 3) uint8 with each channel's light times the median ratio of the photograph's to its
    own."""
    if not mask.any():
        return rgb
    ours, theirs = (linear_of(p[mask] / 255.0) for p in (rgb, photo))
    usable = ours > linear_of(np.array(DARKEST))
    gain = [np.median(theirs[usable[:, k], k] / ours[usable[:, k], k]) if usable[:, k].any() else 1.0 for k in range(3)]
    return np.round(255 * srgb_of(np.clip(linear_of(rgb / 255.0) * gain, 0, 1))).astype(np.uint8)


def compare_held_out(held_out: HeldOut, folder: Path) -> list[HeldOutView]:
    """One a camera: PSNR, SSIM and FLIP against its photograph over the pixels that splats cover, and their share;
    and `matched_psnr_db`, PSNR once the picture's light has the photograph's gain, one number a channel: what exposed
    the photograph is no property of the scan."""
    with PackedFile(held_out.packed) as packed:
        scene = packed.load()
    renderer = Renderer(antialias=USUAL)
    gpu_scene = GpuScene(scene, renderer.context)
    rows = []
    for i, name in zip(
        held_out.cameras, safe_names([scene.header.cameras[i].name for i in held_out.cameras]), strict=True
    ):
        view = limited_view(scene.header.cameras[i], MAX_SIDE_PX)
        picture = renderer.render(gpu_scene, view)
        photo = resized(read_photo(held_out.ingest, i), view.width_px, view.height_px)
        pictures = {"packed": f"{FOLDER}/{name}.packed.png", "photo": f"{FOLDER}/{name}.photo.jpg"}
        for kind, rgb in (("packed", picture.rgb), ("photo", photo)):
            save_picture(Path(folder) / pictures[kind], rgb)
        rows.append(
            HeldOutView(
                camera=view.name,
                width_px=view.width_px,
                height_px=view.height_px,
                coverage=float(np.mean(picture.coverage)),
                psnr_db=psnr_db(picture.rgb, photo, picture.coverage),
                matched_psnr_db=psnr_db(matched(picture.rgb, photo, picture.coverage), photo, picture.coverage),
                ssim=ssim(picture.rgb, photo, picture.coverage),
                flip=flip(picture.rgb, photo, picture.coverage),
                pictures=pictures,
            )
        )
    gpu_scene.release()
    return rows
