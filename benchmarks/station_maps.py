"""What station maps show at fewer points: pictures of a tenth and a hundredth of a laser scan's points, with one colour
a splat and with the maps in the file, against pictures of all points; and how long frames take.

    python -m benchmarks.station_maps SCAN [--station x,y,z] [--shares 0.1 0.01] [--preset balanced] [--json]
        [--keep DIR]             # of packed files and work, for the next run
        [--target-psnr-db 80]    # of maps: from about 45 on without loss, the bound of what maps show at a share

Views: two near the first station, 2 and 20 % of the distance that it looks off it, in the directions in which all
points cover most; and each of them away, 50 degrees to the left and right about what it looks at; one far, where all
points are 200 px large. Textures: one radius for all splats, as before they had sizes, and one colour a splat; one colour
a splat; maps. PSNR and SSIM where both cover. Spill: pixels covered that all points leave open, of those that these
cover. Missing: the other way round. Frames, the seconds of their passes, are timed in turns with those of all
points; the ratio is the median over the rounds.

Where photographs are known that the scan took no colours from, each is compared with its view of the files, on what all
points cover and the file does too. Where it has several stations, each one's points are looked up in the others' maps.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.station_photographs import OtherStation, held_out_photographs, other_stations
from renderer.evaluate.compare import psnr_db, ssim
from renderer.splats.renderer import Picture, Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.views import bulk_of
from storage.packed.packed import PackedFile, PackedScene
from storage.packed.schema import Camera

ONE_RADIUS = "one radius"
SIZE, FIELD_DEGREES, TURN_DEGREES, FAR_PX, ROUNDS = (640, 480), 60.0, 50.0, 200, 5


@dataclass(frozen=True)
class View:
    name: str
    camera: Camera


def looking(name: str, eye: np.ndarray, target: np.ndarray) -> Camera:
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    focal = SIZE[1] / 2 / np.tan(np.radians(FIELD_DEGREES / 2))
    rows = (right, np.cross(forward, right), forward)
    rotation = tuple(tuple(row.tolist()) for row in rows)
    return Camera(name, *SIZE, focal, focal, SIZE[0] / 2, SIZE[1] / 2, rotation, tuple(eye.tolist()))


def views_of(scene: PackedScene, station: np.ndarray, draw) -> list[View]:
    """Near, away and far ones, of a scene of all points that `draw` draws."""
    low, high = bulk_of(scene)
    centre = (low + high) / 2 + scene.header.origin
    reach = float(np.median(np.linalg.norm(centre - station, axis=1)))
    around = [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.arange(12) * np.pi / 6]
    covered = [draw(looking("", station, station + reach * way)).coverage.mean() for way in around]
    first = int(np.argmax(covered))
    apart = [k for k in range(12) if min((k - first) % 12, (first - k) % 12) >= 2]
    chosen = [first, max(apart, key=lambda k: covered[k])]
    found = []
    for number, (k, off) in enumerate(zip(chosen, (0.02, 0.2))):
        side = np.cross(around[k], (0.0, 0.0, 1.0))
        eye, target = station + off * reach * side, station + reach * around[k]
        found.append(View(f"near {number}", looking(f"near {number}", eye, target)))
        for word, angle in (("left", TURN_DEGREES), ("right", -TURN_DEGREES)):
            cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
            arm = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ (eye - target)
            found.append(View(f"away {number} {word}", looking(f"away {number} {word}", target + arm, target)))
    middle, size = (
        (low.min(axis=0) + high.max(axis=0)) / 2 + scene.header.origin,
        np.linalg.norm(high.max(axis=0) - low.min(axis=0)),
    )
    distance = size * found[0].camera.fx_px / FAR_PX
    return [*found, View("far", looking("far", middle + distance * np.array([0.8, 0.0, 0.6]), middle))]


@dataclass(frozen=True)
class Asked:
    """Of the command line."""

    scan: Path
    shares: list[float]
    preset: str
    station: str | None
    target_psnr_db: float | None = None
    keep: Path | None = None  # where packed files and work stay, None for a folder that goes


def folder_of(asked: Asked) -> AbstractContextManager:
    """Of packed files and work."""
    return tempfile.TemporaryDirectory() if asked.keep is None else nullcontext(asked.keep)


def packed(asked: Asked, folder: Path, share: float, texture: str) -> tuple[PackedScene, int]:
    out, work = folder / f"{share} {texture}", folder / "work"
    command = [sys.executable, "-m", "services.cli.main", "compress", str(asked.scan), "--out", str(out)]
    command += ["--preset", asked.preset, "--no-render", "--executor", "serial", "--work", str(work)]
    command += [
        *("--texture", "map" if texture == "map" else "color"),
        *(("--effect", "sizes=off") if texture == ONE_RADIUS else ()),
        *(["--density", str(share)] if share < 1 else []),
        *([f"--station={asked.station}"] if asked.station else []),
        *(["--target-psnr-db", str(asked.target_psnr_db)] if asked.target_psnr_db and texture == "map" else []),
    ]
    if not out.exists():
        subprocess.run(command, check=True, capture_output=True)
    (file,) = out.glob("*.splatpress")
    with PackedFile(file) as opened:
        return opened.load(), file.stat().st_size


def compared(found: Picture, full: Picture) -> dict:
    both, own, all_ = found.coverage & full.coverage, found.coverage & ~full.coverage, max(1, int(full.coverage.sum()))
    return {
        "psnr_db": psnr_db(found.rgb, full.rgb, both),
        "ssim": ssim(found.rgb, full.rgb, both),
        "spill": int(own.sum()) / all_,
        "missing": int((full.coverage & ~found.coverage).sum()) / all_,
    }


@dataclass(frozen=True)
class Found:
    """What was measured, as rows to print."""

    views: list[dict]
    photographs: list[dict]
    other_stations: list[OtherStation]


def measured(asked: Asked) -> Found:
    renderer = Renderer()
    with folder_of(asked) as name:
        of_share = (ONE_RADIUS, "color", "map")
        kinds = [(1.0, "color"), *((share, texture) for share in asked.shares for texture in of_share)]
        made = {kind: packed(asked, Path(name), *kind) for kind in kinds}
        others = [] if asked.station else other_stations(asked.scan, Path(name) / "work")
    scenes, sizes = ({kind: pair[i] for kind, pair in made.items()} for i in (0, 1))
    drawn = {key: GpuScene(scene, renderer.context) for key, scene in scenes.items()}
    full, of_all = drawn[1.0, "color"], scenes[1.0, "color"]
    maps = next(scene.header.maps for (_, texture), scene in scenes.items() if texture == "map")
    if not maps:
        raise SystemExit(f"{asked.scan}: no station; allowed: a scan with stations, or --station")
    rows, photographs = [], []
    for view in views_of(of_all, np.array(maps[0].centre), lambda camera: renderer.render(full, camera)):
        reference = renderer.render(full, view.camera)
        for key in list(scenes)[1:]:
            row = {"view": view.name, "share": key[0], "texture": key[1], "file_bytes": sizes[key]}
            row |= compared(renderer.render(drawn[key], view.camera), reference)
            rows.append(row | {"times_as_fast": faster(renderer, full, drawn[key], view.camera)})
    for camera, photo in held_out_photographs(asked.scan):
        reference = renderer.render(full, camera)
        for (share, texture), scene in drawn.items():
            picture = renderer.render(scene, camera)
            both = picture.coverage & reference.coverage
            row = {"view": camera.name, "share": share, "texture": texture, "file_bytes": sizes[share, texture]}
            row |= {"psnr_db": psnr_db(picture.rgb, photo, both), "ssim": ssim(picture.rgb, photo, both)}
            photographs.append(row | {"covers": float(both.sum() / reference.coverage.sum())})
    return Found(rows, photographs, others)


def faster(renderer: Renderer, full: GpuScene, thin: GpuScene, camera: Camera) -> float:
    """How many frames are drawn while one of all points is."""

    def seconds(scene: GpuScene) -> float:
        return sum(renderer.render(scene, camera).pass_seconds.values())

    return statistics.median(seconds(full) / seconds(thin) for _ in range(ROUNDS))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--station")
    parser.add_argument("--shares", type=float, nargs="+", default=[0.1, 0.01])
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--target-psnr-db", type=float)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    of_scan = options.scan, options.shares, options.preset, options.station
    found = measured(Asked(*of_scan, options.target_psnr_db, options.keep))
    if options.json:
        print(json.dumps(asdict(found)))
        return
    print(
        f"{'view':15} {'share':>6} {'texture':10} {'file kB':>8} {'PSNR dB':>8} {'SSIM':>6} {'spill':>7} {'missing':>8} {'as fast':>8}"
    )
    for r in found.views:
        print(f"{_figures(r)} {r['spill']:7.2%} {r['missing']:8.2%} {r['times_as_fast']:7.1f}x")
    if found.photographs:
        print(f"{'photograph':15} {'share':>6} {'texture':10} {'file kB':>8} {'PSNR dB':>8} {'SSIM':>6} {'covers':>7}")
        for r in found.photographs:
            print(f"{_figures(r)} {r['covers']:7.2%}")
    for other in found.other_stations:
        print(
            f"points of station {other.of} in the map of {other.by}, {other.apart:.1f} away: wrong {other.wrong_untested:.1%}; with the depth test "
            f"{other.seen * other.wrong:.1%} of all, {other.wrong:.1%} of the {other.seen:.0%} that it shows"
        )


def _figures(r: dict) -> str:
    psnr, alike = (f"{r[k]:.{n}f}" if r[k] is not None else "-" for k, n in (("psnr_db", 2), ("ssim", 3)))
    return f"{r['view']:15} {r['share']:6g} {r['texture']:10} {r['file_bytes'] / 1e3:8.0f} {psnr:>8} {alike:>6}"


if __name__ == "__main__":
    main()
