"""`fly`: a recorded path drawn with pages, frame by frame, and what each frame cost and missed."""

from __future__ import annotations

import shutil
import subprocess
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from renderer.evaluate.flight import Flight, FrameRecord
from renderer.files import write_json
from renderer.pictures import on_background, save_picture
from renderer.residency.paths import FRAMES_PER_SECOND, Path90, read_path
from renderer.residency.places import Screen
from renderer.residency.prediction import motion_at
from renderer.splats.pages import GpuPages
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from services.processes.pages.table import four_paths, places_with_photographs
from storage.errors import InvalidPackedFile
from storage.packed.packed import PackedFile
from storage.packed.schema import Header
from storage.pages.file import PageFile, scan_digest
from storage.whole import placed_whole

FLIGHT = "fly.json"


@dataclass(frozen=True)
class FlightOptions:
    """How a path is flown."""

    size_px: tuple[int, int] = (720, 780)
    pool_bytes: int = 256 << 20
    bytes_a_second: float = 200e6  # of texels, as they are put into the pool
    prediction: str = "combined"
    policy: str = "default"
    every: int = 1  # n-th pose of the path is drawn


def fly(packed: Path, pages: Path, path: Path, out: Path, options: FlightOptions = FlightOptions()) -> dict:
    """Draw the path into `out`: frame_0000.png and on, flight.mp4 where ffmpeg is found, and FLIGHT, which is returned.

    The viewer stands still until what he sees is there; then the path begins. `out` appears whole or not at all.

    Raises: InvalidPackedFile for a page file that is cut, altered or of another scan, ResourceExhausted for a pool that
    does not hold what is always resident.
    """
    walk = read_path(path)
    walk = Path90(walk.name, walk.poses[:: options.every])
    with PackedFile(packed) as opened:
        scene = opened.load()
    with PageFile(pages) as file:
        refuse_another_scan(file, scene.header)
        places, label = places_with_photographs(packed, scene, 1, file.layout.page_px)
        _, distance = four_paths(scene, places)
        renderer = Renderer()
        gpu_scene = GpuScene(scene, renderer.context)
        try:
            gpu_scene.pages = GpuPages(
                renderer.context, file.layout, file.header.border_px, scene.header.cameras, label, options.pool_bytes
            )
            page_bytes = 3 * file.header.side_px**2
            n_frame = max(1, int(options.bytes_a_second / FRAMES_PER_SECOND / page_bytes))
            width, height = options.size_px
            flight = Flight(
                renderer, gpu_scene, places, file, Screen(width, height, width / 2), distance, options.prediction,
                options.policy == "paper", n_frame,
            )  # fmt: skip
            with closing(flight), placed_whole(out) as made:
                settled = flight.settle(walk.poses[0])
                records = [_frame(flight, walk, i, options.every, made) for i in range(len(walk.poses))]
                found = _document(walk, options, n_frame, gpu_scene.pages, settled, records)
                found["warnings"] = warnings_of(file, scene.header)
                if settled == flight.most_settling:
                    found["warnings"].append(
                        f"after {settled} frames pages of the first view still came and went: the pool holds "
                        f"{gpu_scene.pages.shape.n_pages}; a larger --pool-mib holds them"
                    )
                found["video"] = _video(made, FRAMES_PER_SECOND / options.every)
                write_json(made / FLIGHT, found)
        finally:
            if gpu_scene.pages is not None:
                gpu_scene.pages.release()
            gpu_scene.release()
    return found


def refuse_another_scan(file: PageFile, header: Header) -> None:
    """Raises: InvalidPackedFile for a page file of other photographs than those of the packed file."""
    if file.header.scan != scan_digest(header.cameras):
        raise InvalidPackedFile(
            str(file.path),
            f"pages of another scan ({len(file.header.names)} photographs, scan {file.header.scan})",
            f"those of this packed file ({len(header.cameras)} photographs, scan {scan_digest(header.cameras)})",
        )


def warnings_of(file: PageFile, header: Header) -> list[str]:
    """What pictures of these pages would show and a viewer might take for the scan: atoms and pages in different
    light."""
    if file.header.one_light or "exposure" not in header.effects:
        return []
    return [
        f"{file.path.name}: pages of photographs as they were taken, atoms as if in one light (effect exposure): seams show "
        "where pages come; make the pages from the folder of `compress --work`"
    ]


def _frame(flight: Flight, walk: Path90, i: int, every: int, out: Path) -> FrameRecord:
    picture, record = flight.frame(walk.poses[i], motion_at(walk.poses, i, FRAMES_PER_SECOND / every))
    save_picture(out / f"frame_{i:04d}.png", on_background(picture.rgb, picture.alpha, (0, 0, 0)))
    return record


def _document(
    walk: Path90, options: FlightOptions, n_frame: int, pages: GpuPages, settled: int, records: list[FrameRecord]
) -> dict:
    passes = {name: [r.pass_ms[name] for r in records] for name in records[0].pass_ms}
    total = np.sum([list(r.pass_ms.values()) for r in records], axis=1)
    return {
        "path": walk.name,
        **asdict(options),
        "pages_a_frame": n_frame,
        "pages_in_pool": pages.shape.n_pages,
        "pool_used_bytes": pages.shape.n_bytes,
        "settled_after_frames": settled,
        "frame_ms": _spread(total),
        "pass_ms": {name: _spread(np.array(values)) for name, values in passes.items()},
        "missed_pixels": float(np.mean([r.missed_pixels for r in records])),
        "missed_pages": float(np.mean([r.missed for r in records])),
        "wanted_pages": float(np.mean([r.wanted for r in records])),
        "loaded": sum(r.loaded for r in records),
        "mapped": sum(r.mapped for r in records),
        "evicted": sum(r.evicted for r in records),
        "late": sum(r.late for r in records),
        "frames": [asdict(r) for r in records],
    }


def _spread(values: np.ndarray) -> dict[str, float]:
    """As the boxes of Figure 9: extrema, quartiles, median."""
    names = ("least", "lower_quartile", "median", "upper_quartile", "most")
    return dict(zip(names, np.percentile(values, (0, 25, 50, 75, 100)).tolist(), strict=True))


def _video(folder: Path, frames_a_second: float) -> str | None:
    """flight.mp4 of the frames, where ffmpeg is found and takes them."""
    ffmpeg = shutil.which("ffmpeg")
    if ffmpeg is None:
        return None
    command = [ffmpeg, "-loglevel", "error", "-framerate", f"{frames_a_second:g}", "-i", "frame_%04d.png",
               "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", "flight.mp4"]  # fmt: skip
    ran = subprocess.run(command, cwd=folder, capture_output=True, check=False)
    return "flight.mp4" if ran.returncode == 0 else None
