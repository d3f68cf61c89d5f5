"""A whole laser scan in few bytes: files with textures and all levels against the file of one colour a point, by the
colours of points that none of them was made from.

    python -m benchmarks.station_whole SCAN.laz --station x,y,z [--every 16]

One point of so many is held out. The others are compressed with the options of each row. Views: four from the
station, 90 degrees apart; and away, two, 50 degrees to either side of what the first looks at. PSNR is over the held-out
points that a view sees (renderer/evaluate/stations/seen_points.py) and all files cover. Beside them stands the map
itself, uncoded, looked up where these points lie: what textures can show at most.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import laspy
import numpy as np

from benchmarks.station_maps import looking
from pipeline.maps.station_map import StationMap
from pipeline.stages.maps.panoramas import read_map
from renderer.evaluate.compare import psnr_of_error
from renderer.evaluate.stations.seen_points import seen_points
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from storage.packed.packed import PackedFile
from storage.packed.schema import Camera

ROWS = (
    ("all points, one colour", ("--texture", "color")),
    ("a quarter, atoms", ("--density", "0.25", "--texture", "atoms")),
    ("a tenth, maps", ("--density", "0.1", "--texture", "map")),
    ("a quarter, maps, draft", ("--density", "0.25", "--texture", "map", "--preset", "draft")),
    ("a third, maps, draft", ("--density", "0.33", "--texture", "map", "--preset", "draft")),
)


def split(scan: Path, every: int, rest: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Writes the points that are kept; positions (n, 3) and colours (n, 3) uint8 of all, and which are held out (n,)."""
    read = laspy.read(scan)
    held_out = np.random.default_rng(0).random(len(read.points)) < 1 / every
    kept = laspy.LasData(read.header)
    kept.points = read.points[~held_out]
    kept.write(rest)
    color = np.stack([read.red, read.green, read.blue], axis=1)
    return np.asarray(read.xyz), (color >> 8 if color.max() > 255 else color).astype(np.uint8), held_out


def views_from(station: np.ndarray, points: np.ndarray) -> list[Camera]:
    reach = float(np.median(np.linalg.norm(points - station, axis=1)))
    ways = [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.arange(4) * np.pi / 2]
    views = [looking(f"station {i}", station, station + reach * way) for i, way in enumerate(ways)]
    target = station + reach * ways[0]
    for word, angle in (("left", 50.0), ("right", -50.0)):
        cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        arm = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ (station - target)
        views.append(looking(f"away {word}", target + arm, target))
    return views


def colors_in_map(station_map: StationMap, points: np.ndarray) -> np.ndarray:
    """The colours (n, 3) uint8 of the texels that points (n, 3) fall into."""
    pixels, _ = station_map.frame.projection.project(points)
    column, row = np.minimum(pixels.astype(int), np.array(station_map.frame.projection.size) - 1).T
    return station_map.color[row, column, :3]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--station", required=True)
    parser.add_argument("--every", type=int, default=16)
    options = parser.parse_args()
    renderer = Renderer()
    with tempfile.TemporaryDirectory() as name:
        rest = Path(name) / "rest.laz"
        points, colors, held_out = split(options.scan, options.every, rest)
        scenes, sizes = [], []
        for i, (_, words) in enumerate(ROWS):
            command = [sys.executable, "-m", "services.cli.main", "compress", str(rest), "--out", f"{name}/{i}"]
            command += ["--no-render", "--executor", "serial", "--work", f"{name}/work", f"--station={options.station}"]
            subprocess.run([*command, *words], check=True, capture_output=True)
            (file,) = Path(name, str(i)).glob("*.splatpress")
            with PackedFile(file) as opened:
                scenes.append(GpuScene(opened.load(), renderer.context))
            sizes.append(file.stat().st_size)
        (folder,) = Path(name, "work").glob("panoramas-*")
        of_map = colors_in_map(read_map(folder, 0), points)
    print(f"{'view':12} {'held out':>8}" + "".join(f" {words:>22}" for words, _ in ROWS) + "            map itself")
    print(f"{'kB':12} {'':>8}" + "".join(f" {size / 1e3:22.0f}" for size in sizes))
    for view in views_from(np.array([float(x) for x in options.station.split(",")]), points):
        pictures = [renderer.render(scene, view) for scene in scenes]
        covered = np.all([picture.coverage for picture in pictures], axis=0)
        seen = seen_points(view, points)
        asked = held_out[seen.rows]
        seen = type(seen)(seen.rows[asked], seen.pixel[asked])
        found = [seen.psnr_db(picture.rgb, colors, covered) for picture in pictures]
        figures = (f" {f'{db:.2f} dB' if db else '-':>22}" for db, _ in found)
        kept = seen.rows[covered[tuple(seen.pixel.T)]]
        bound = psnr_of_error(float(((of_map[kept].astype(float) - colors[kept]) ** 2).mean())) if len(kept) else 0.0
        print(f"{view.name:12} {found[0][1]:8}" + "".join(figures) + f" {bound:18.2f} dB", flush=True)


if __name__ == "__main__":
    main()
