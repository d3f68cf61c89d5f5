"""More photographs than memory holds: `python -m benchmarks.large_photos FOLDER [--side 21] [--size 3680x2456]`.

Makes a COLMAP workspace of side^2 procedural JPEGs of a wall (441 of 9 megapixels: 11.9 GB raw), compresses it with
pages by all workers, flies a path in a pool of 256 MiB, and reads pages as loaders do; each in a process of its own,
whose peak memory is told. FOLDER takes about 20 GB, and is left for another look: delete it.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image
from scipy.ndimage import gaussian_filter

from pipeline.stages.pages.codecs import decoded
from storage.pages.file import PageFile
from tests.pipeline.readers.workspace import write_ply, write_vis

TILE_PX, PX_A_UNIT, DISTANCE = 4096, 1000, 3.0  # of the wall's texture, which repeats; cameras stand a unit apart
N_SIDE = 300  # points to a side
QUALITY = 90
READ = 20_000  # pages


def wall_tile() -> np.ndarray:
    """(TILE_PX, TILE_PX, 3) uint8: noise of several octaves."""
    rng, total = np.random.default_rng(7), np.zeros((TILE_PX, TILE_PX, 3), np.float32)
    for octave in range(1, 7):
        side = TILE_PX >> octave
        grain = gaussian_filter(rng.normal(size=(side, side, 3)).astype(np.float32), (0.7, 0.7, 0), mode="wrap")
        total += grain.repeat(1 << octave, axis=0).repeat(1 << octave, axis=1) * 2.0 ** (octave / 2)
    return np.clip(128 + 14 * total, 0, 255).astype(np.uint8)


def write_photos(folder: Path, tile_file: Path, numbers: list[int], side: int, size: tuple[int, int]) -> None:
    """The photographs of these numbers, pixel for pixel of the wall."""
    tile = np.load(tile_file, mmap_mode="r")
    for i in numbers:
        left, top = (PX_A_UNIT * n - extent // 2 for n, extent in zip((i % side, i // side), size, strict=True))
        rows, columns = (np.arange(at, at + n) % TILE_PX for at, n in ((top, size[1]), (left, size[0])))
        picture = np.take(np.take(tile, rows, axis=0), columns, axis=1)
        Image.fromarray(picture).save(folder / f"{i:04d}.jpg", quality=QUALITY, subsampling=0)


def make_scan(path: Path, side: int, size: tuple[int, int], n_workers: int) -> None:
    images = path / "images"
    images.mkdir(parents=True)
    (path / "sparse").mkdir()
    tile_file = path.parent / "tile.npy"
    np.save(tile_file, wall_tile())
    with ProcessPoolExecutor(n_workers) as pool:
        parts = [list(range(k, side * side, n_workers)) for k in range(n_workers)]
        list(pool.map(write_photos, *zip(*((images, tile_file, part, side, size) for part in parts), strict=True)))
    focal = PX_A_UNIT * DISTANCE
    params = [focal, focal, size[0] / 2, size[1] / 2]
    camera = pycolmap.Camera(model="PINHOLE", width=size[0], height=size[1], params=params, camera_id=1)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    centres = np.array([(i % side, i // side, -DISTANCE) for i in range(side * side)], float)
    for i, centre in enumerate(centres):
        image = pycolmap.Image(name=f"{i:04d}.jpg", keypoints=np.full((5, 2), 7.0), camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), -centre))
    model.write_binary(str(path / "sparse"))
    x, y = (a.ravel() for a in np.meshgrid(*(np.linspace(-0.5, side - 0.5, N_SIDE),) * 2))
    position = np.stack([x, y, np.zeros_like(x)], axis=1).astype(np.float32)
    reach = np.array(size) / PX_A_UNIT / 2 - 0.15
    inside = (np.abs(position[:, None, :2] - centres[None, :, :2]) < reach).all(axis=2)
    write_ply(
        path / "fused.ply", position, np.tile(np.float32([0, 0, -1]), (len(x), 1)), np.full((len(x), 3), 128, np.uint8)
    )
    write_vis(path / "fused.ply.vis", tuple(tuple(np.flatnonzero(row).tolist()) for row in inside))


def told(name: str, *arguments: str) -> None:
    """Run a command of splatpress in a process of its own, and tell what it took. Its peak is no less than this
    process's own memory."""
    begun = time.monotonic()
    child = subprocess.Popen([sys.executable, "-m", "services.cli.main", *arguments])
    _, status, used = os.wait4(child.pid, 0)
    if status:
        raise SystemExit(f"{name} ended with {status}")
    print(f"{name}: {time.monotonic() - begun:.0f} s, peak of the process {used.ru_maxrss / 2**10:.0f} MiB", flush=True)


def read_speed(pages: Path) -> None:
    with PageFile(pages) as file:
        chosen = np.random.default_rng(3).integers(0, file.layout.n_pages, min(READ, file.layout.n_pages))
        begun, clock = time.process_time(), time.monotonic()
        for page in chosen.tolist():
            decoded(file.header.codec, file.read(page), file.header.side_px, "a page")
        used, took = time.process_time() - begun, time.monotonic() - clock
        print(f"read: {len(chosen) / used:,.0f} pages a second of processor ({len(chosen) / took:,.0f} of the clock)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--side", type=int, default=21)
    parser.add_argument("--size", type=lambda text: tuple(map(int, text.split("x"))), default=(3680, 2456))
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    scan, out, work = (options.folder / name for name in ("wall", "out", "work"))
    if not scan.exists():
        making = multiprocessing.get_context("spawn").Process(
            target=make_scan, args=(scan, options.side, options.size, options.workers)
        )
        making.start()
        making.join()
    packed, path = out / "wall.splatpress", options.folder / "path.json"
    if not packed.exists():
        told("compress --pages", "compress", str(scan), "--out", str(out), "--work", str(work), "--preset", "draft", "--texture", "color",
             "--pages", "--effect", "exposure=off", "--no-render", "--workers", str(options.workers))  # fmt: skip
    report = json.loads((out / "report.json").read_text())
    for stage in report["stages"]:
        if stage["name"] in ("ingest", "photo-pages"):
            print(
                f"{stage['name']}: {stage['seconds']:.0f} s, {stage['tasks']} tasks, peak of a worker {stage['peak_rss_bytes'] / 2**20:.0f} MiB"
            )
    print(f"pages: {report['pages']}")
    read_speed(out / "wall.pages")
    told("path record", "path", "record", str(packed), "--through", "sideways", "--out", str(path))
    told("fly", "fly", str(packed), "--path", str(path), "--out", str(options.folder / "flight"), "--overwrite", "--every", "20",
         "--size", "480x480", "--pool-mib", "256")  # fmt: skip


if __name__ == "__main__":
    main()
