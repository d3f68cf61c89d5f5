"""What pages show beyond atoms, by how wide splats are: `python -m benchmarks.page_detail WORK PACKED [PACKED ...]`.

WORK holds the stages of all files (`compress --work`), of one scan at several densities. Each photograph's middle is
drawn from where it was taken, 1, 2 and 4 times as large: with atoms alone, and with the pages of the photographs, all
of them there. Compared with the photograph, where it is covered: PSNR, and the detail that a Gaussian of 2 px takes
out, as the share of the photograph's energy and its correlation with the photograph's. Means over photographs; `width`
is the measure of the effect `pages`.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import binary_erosion, gaussian_filter

from pipeline.effects.exposure.photographs import read_photo
from pipeline.execution.executors import SerialExecutor
from pipeline.stages.pages.codecs import decoded
from pipeline.stages.pages.coded import PageForm
from renderer.evaluate.close_ups import window_view
from renderer.residency.scene import scene_places
from renderer.splats.pages import GpuPages
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from services.cli.commands.running import progress_bars
from services.processes.pages.page_file import make_pages, photos_of
from storage.packed.packed import PackedFile
from storage.pages.file import PageFile

SIDE_PX, ZOOMS, SIGMA_PX, RIM_PX = 256, (1, 2, 4), 2.0, 6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("packed", type=Path, nargs="+")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        pages = Path(folder) / "a.pages"
        make_pages(options.work, pages, PageForm(), SerialExecutor(), progress_bars())
        print(f"{'splats':>8} {'width':>6} {'zoom':>4} {'atoms dB':>8} {'pages dB':>8} {'gain':>6} {'least':>6}  "
              f"{'energy atoms/pages':>18}  {'correlation':>11}")  # fmt: skip
        for packed in options.packed:
            measure(packed, pages, photos_of(options.work))


def measure(packed: Path, pages: Path, photos: Path) -> None:
    with PackedFile(packed) as opened:
        scene = opened.load()
    places, label = scene_places(scene)
    width = 2 * places.radius * 2.0**places.octaves
    renderer = Renderer()
    gpu_scene = GpuScene(scene, renderer.context)
    cameras = scene.header.cameras
    rows = []
    with PageFile(pages) as file:
        gpu_pages = GpuPages(renderer.context, file.layout, file.header.border_px, cameras, label, 1 << 30)
        for page in range(file.layout.n_pages):
            gpu_pages.put(page, decoded(file.header.codec, file.read(page), file.header.side_px, "a page"))
        for i, camera in enumerate(cameras):
            photo = read_photo(photos, i)
            for zoom in ZOOMS:
                side = SIDE_PX
                left, top = (camera.width_px - side) // 2, (camera.height_px - side) // 2
                view = window_view(replace(camera), left, top, side, zoom)
                cut = Image.fromarray(photo[top : top + side, left : left + side])
                truth = np.asarray(cut.resize((side * zoom, side * zoom), Image.Resampling.BICUBIC))
                gpu_scene.pages = None
                atoms = renderer.render(gpu_scene, view)
                gpu_scene.pages = gpu_pages
                gpu_pages.show_all(view.width_px, view.height_px)
                paged = renderer.render(gpu_scene, view)
                mask = binary_erosion(atoms.coverage, iterations=RIM_PX)
                if mask.mean() < 0.3:
                    continue
                rows.append((zoom, *compared(truth, atoms.rgb, mask), *compared(truth, paged.rgb, mask)))
        gpu_pages.release()
    gpu_scene.release()
    for zoom in ZOOMS:
        found = np.array([row[1:] for row in rows if row[0] == zoom])
        m, gain = found.mean(axis=0), found[:, 3] - found[:, 0]
        print(
            f"{scene.header.n_splats:8,} {np.median(width) / 32:6.3f} {zoom:4} {m[0]:8.2f} {m[3]:8.2f} {gain.mean():6.2f} {gain.min():6.2f}  "
            f"{m[1]:9.2f}{m[4]:9.2f}  {m[2]:5.2f}{m[5]:6.2f}",
            flush=True,
        )


def compared(truth: np.ndarray, found: np.ndarray, mask: np.ndarray) -> tuple[float, float, float]:
    """PSNR; energy of fine detail as a share of the truth's; its correlation with the truth's."""
    error = ((truth.astype(float) - found)[mask] ** 2).mean()
    a, b = (detail(picture)[mask] for picture in (truth, found))
    return 10 * np.log10(255**2 / error), float((b * b).sum() / (a * a).sum()), float(
        (a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum())
    )  # fmt: skip


def detail(rgb: np.ndarray) -> np.ndarray:
    grey = rgb.astype(float).mean(axis=-1)
    return grey - gaussian_filter(grey, SIGMA_PX)


if __name__ == "__main__":
    main()
