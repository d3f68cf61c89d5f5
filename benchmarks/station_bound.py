"""What maps of stations can show of a view that is not theirs: pictures of a tenth of a laser scan's points, against one
in which each pixel is looked up in the map where the surface of all points lies, which no file of fewer points knows.

    python -m benchmarks.station_bound SCAN [--station x,y,z] [--share 0.1] [--preset balanced] [--pictures DIR]

Views are those of `benchmarks.station_maps`, pictures are compared with those of all points, where all that are compared
cover. Columns: one radius for all splats; one colour a splat; the maps; the map itself, uncoded, at the surface that the
fewer points have; and at that of all points. Where the map shows nothing there, for nothing was seen or something stood
before it, these two have the pixels of one colour a splat. The last is the bound: surfaces are right, nothing is coded.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from benchmarks.station_maps import ONE_RADIUS, Asked, folder_of, packed, views_of
from pipeline.maps.station_map import NOTHING, StationMap, decode_distances
from pipeline.stages.maps.panoramas import read_map
from renderer.evaluate.compare import psnr_db
from renderer.pictures import save_picture
from renderer.splats.projection import NEAR_IN_RADII
from renderer.splats.renderer import Picture, Renderer
from renderer.splats.scene import GpuScene
from storage.packed.schema import Camera

OFF = 0.03  # of the distance, by which a map's surface may be another one's: thrice what lookups allow amid a splat


def surface(renderer: Renderer, scene: GpuScene, view: Camera) -> tuple[Picture, np.ndarray]:
    """A picture, and the points (h, w, 3) that its pixels show, half a radius behind them as depth is drawn."""
    picture = renderer.render(scene, view)
    with renderer.context:
        depth = np.frombuffer(renderer._targets.visibility.read(components=1, attachment=-1, dtype="f4"), np.float32)
    depth = depth.reshape(view.height_px, view.width_px).astype(np.float64)
    z = NEAR_IN_RADII * scene.scene.header.radius / np.maximum(depth, 1e-30)
    column, row = np.meshgrid(np.arange(view.width_px) + 0.5, np.arange(view.height_px) + 0.5)
    local = np.stack([(column - view.cx_px) / view.fx_px, (row - view.cy_px) / view.fy_px, np.ones_like(z)], axis=-1)
    points = (np.where(picture.coverage, z, 1.0)[..., None] * local) @ np.array(view.rotation) + np.array(view.centre)
    return picture, points


def looked_up(maps: list[StationMap], points: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """The colours (h, w, 3) uint8 of points in the first map that shows them, bilinear among texels that do, else those
    of a picture."""
    found, known = otherwise.reshape(-1, 3).astype(np.float64), np.zeros(points[..., 0].size, bool)
    flat = points.reshape(-1, 3)
    for station_map in maps:
        projection, frame = station_map.frame.projection, station_map.frame
        away = np.linalg.norm(flat - np.asarray(frame.centre), axis=1)
        at = projection.project(flat)[0] - 0.5
        corner, sums, weights = np.floor(at).astype(int), np.zeros((len(flat), 3)), np.zeros(len(flat))
        for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
            column, row = np.clip(corner + (x, y), 0, np.array(projection.size) - 1).T
            code = station_map.depth[row, column]
            seen = (code != NOTHING) & (np.abs(decode_distances(code, frame) - away) <= OFF * away)
            weight = seen * np.abs(np.array([1 - x, 1 - y]) - (at - corner)).prod(axis=1)
            sums += weight[:, None] * station_map.color[row, column, :3]
            weights += weight
        shown = (weights > 0) & ~known
        found[shown] = sums[shown] / weights[shown, None]
        known |= shown
    return np.rint(found).astype(np.uint8).reshape(otherwise.shape)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--station")
    parser.add_argument("--share", type=float, default=0.1)
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    of_scan = options.scan, [options.share], options.preset, options.station
    asked, renderer = Asked(*of_scan, keep=options.keep), Renderer()
    kinds = [(1.0, "color"), *((options.share, texture) for texture in (ONE_RADIUS, "color", "map"))]
    with folder_of(asked) as name:
        full, *thin = (GpuScene(packed(asked, Path(name), *kind)[0], renderer.context) for kind in kinds)
        (folder,) = Path(name, "work").glob("panoramas-*")
        maps = [m for i in range(len(thin[2].scene.header.maps)) if (m := read_map(folder, i)) is not None]
    words = [ONE_RADIUS, "one colour", "maps", "map, its surface", "map, all points'"]
    print(f"{'view':14}" + "".join(f"{word:>18}" for word in words) + "   bound over one colour")
    for view in views_of(full.scene, np.array(maps[0].frame.centre), lambda c: renderer.render(full, c)):
        reference, of_all = surface(renderer, full, view.camera)
        (one_radius, _), (flat, points), (textured, _) = (surface(renderer, scene, view.camera) for scene in thin)
        both = reference.coverage & one_radius.coverage & flat.coverage & textured.coverage
        itself, bound = (looked_up(maps, at, flat.rgb) for at in (points, of_all))
        shown = [one_radius.rgb, flat.rgb, textured.rgb, itself, bound]
        found = [psnr_db(rgb, reference.rgb, both) or 0.0 for rgb in shown]
        figures = "".join(f"{db:15.2f} dB" for db in found)
        print(f"{view.name:14}{figures}{found[-1] - found[1]:18.2f} dB", flush=True)
        for word, rgb in zip(["all points", *words], [reference.rgb, *shown]) if options.pictures else ():
            save_picture(options.pictures / f"{view.name}.{word}.png".replace(" ", "_").replace("'", ""), rgb)


if __name__ == "__main__":
    main()
