"""What a packed file shows where a photograph was taken that it was made without."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from renderer.compare import flip, psnr_db, ssim
from renderer.pictures import resized, save_picture
from renderer.previews import limited_view, safe_names
from renderer.renderer import Renderer
from renderer.scene import GpuScene
from storage import arrays
from storage.packed import PackedFile

FOLDER = "held-out"
MAX_SIDE_PX = 1600


@dataclass(frozen=True)
class HeldOut:
    """A packed file, the folder of the ingest stage, and the cameras whose photographs textured nothing."""

    packed: Path
    ingest: Path
    cameras: tuple[int, ...]


def compare_held_out(held_out: HeldOut, folder: Path) -> list[dict]:
    """A row a camera: PSNR, SSIM and FLIP against its photograph over the pixels that splats cover, and their share."""
    with PackedFile(held_out.packed) as packed:
        scene = packed.load()
    renderer = Renderer()
    gpu_scene = GpuScene(scene, renderer.context)
    rows = []
    for i, name in zip(held_out.cameras, safe_names([scene.header.cameras[i].name for i in held_out.cameras]), strict=True):
        view = limited_view(scene.header.cameras[i], MAX_SIDE_PX)
        picture = renderer.render(gpu_scene, view)
        photo = resized(arrays.read(held_out.ingest, f"photo_{i}"), view.width_px, view.height_px)
        pictures = {"packed": f"{FOLDER}/{name}.packed.png", "photo": f"{FOLDER}/{name}.photo.jpg"}
        for kind, rgb in (("packed", picture.rgb), ("photo", photo)):
            save_picture(Path(folder) / pictures[kind], rgb)
        rows.append({"camera": view.name, "width_px": view.width_px, "height_px": view.height_px,
                     "coverage": float(np.mean(picture.coverage)), "psnr_db": psnr_db(picture.rgb, photo, picture.coverage),
                     "ssim": ssim(picture.rgb, photo, picture.coverage), "flip": flip(picture.rgb, photo, picture.coverage),
                     "pictures": pictures})
    gpu_scene.release()
    return rows
