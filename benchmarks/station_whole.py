"""A whole laser scan in few bytes: files with textures and all levels against the file of one colour a point, by the
colours of points that none of them was made from.

    python -m benchmarks.station_whole SCAN.laz --station x,y,z [--every 16]

One point of so many is held out. The others are compressed with the options of each row; the first is one radius for
all, as scans were packed before splats had sizes. Views: four from the station, 90 degrees apart, and one as far off it
as 20 % of what it looks at is away; and away, two, 50 degrees to either side of what the first looks at. PSNR is over
the held-out points that a view sees (renderer/evaluate/stations/seen_points.py); what a file leaves open shows the
background, which is grey. Then the same where all files cover, and what is left open of these points. Beside them stands the map
itself, uncoded, looked up where these points lie: what textures can show at most. `--pictures DIR` keeps all pictures.
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
from renderer.pictures import on_background, save_picture
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from storage.packed.packed import PackedFile
from storage.packed.schema import Camera

GREY = (128, 128, 128)  # no colour is nearer to all others
ROWS = (
    ("one radius", ("--texture", "color", "--effect", "sizes=off")),
    ("one colour", ("--texture", "color")),
    ("quarter, atoms", ("--density", "0.25", "--texture", "atoms")),
    ("tenth, maps", ("--density", "0.1", "--texture", "map")),
    ("third, maps, draft", ("--density", "0.33", "--texture", "map", "--preset", "draft")),
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
    side = 0.2 * reach * np.cross(ways[0], (0.0, 0.0, 1.0))
    views.append(looking("beside it", station + side, target))
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
    parser.add_argument("--pictures", type=Path)
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
    print(f"{'view':12} {'held out':>8}" + "".join(f" {words:>22}" for words, _ in ROWS) + f"{'map itself':>12}")
    print(f"{'kB':12} {'':>8}" + "".join(f" {size / 1e3:22.0f}" for size in sizes))
    for view in views_from(np.array([float(x) for x in options.station.split(",")]), points):
        pictures = [renderer.render(scene, view) for scene in scenes]
        seen = seen_points(view, points)
        asked = held_out[seen.rows]
        seen = type(seen)(seen.rows[asked], seen.pixel[asked])
        if not len(seen.rows):
            continue
        covers = [picture.coverage for picture in pictures]
        shown = [on_background(picture.rgb, picture.coverage, GREY) for picture in pictures]
        figures = []
        for i, (rgb, own) in enumerate(zip(shown, covers, strict=True)):
            all_db, _ = seen.psnr_db(rgb, colors, np.ones_like(own))
            both_db, _ = seen.psnr_db(rgb, colors, np.all(covers, axis=0))
            figures.append(f" {all_db or 0:6.2f} {both_db or 0:6.2f} dB {1 - own[tuple(seen.pixel.T)].mean():5.1%}")
            if options.pictures:
                save_picture(options.pictures / f"{view.name}.{ROWS[i][0]}.png".replace(" ", "_"), rgb)
        bound = psnr_of_error(float(((of_map[seen.rows].astype(float) - colors[seen.rows]) ** 2).mean()))
        words = "".join(f"{figure:>23}" for figure in figures)
        print(f"{view.name:12} {len(seen.rows):8}{words}{bound:9.2f} dB", flush=True)


if __name__ == "__main__":
    main()
