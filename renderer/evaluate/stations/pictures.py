"""What stations of a laser scan saw, as pictures, and what it brings a picture: the packed file with its textures and
with one colour a splat, against the colours that the stations saw.

The truth is points: the texels of the maps, where they lie. Near views stand at a station, away views TURN_DEGREES to
either side of it about what it looks at.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.maps.files import name_of, upright
from pipeline.maps.light import levels_with
from pipeline.maps.station_map import NOTHING, StationMap, decode_distances
from pipeline.stages.maps.panoramas import read_map
from renderer.evaluate.previews import even_choice
from renderer.evaluate.stations.seen_points import SeenPoints, seen_points
from renderer.pictures import on_background, resized, save_picture
from renderer.report.document import StationShown, StationView
from renderer.splats.renderer import Picture, Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.targets import USUAL
from renderer.splats.views import station_views
from storage.packed.packed import PackedFile, PackedScene
from storage.packed.schema import Camera

FOLDER = "maps"
MOST_SHOWN, MOST_SEEN, MOST_VIEWED = 12, 4, 2  # stations with pictures, whose points are the truth, with views
MOST_POINTS = 1 << 20  # of a station
MAP_WIDTH_PX, VIEW_PX = 960, (480, 360)
TURN_DEGREES = 50.0
NOT_SEEN = (40, 40, 40)

Gains = tuple[tuple[float, float, float], ...]


def draw_stations(packed: Path, maps: Path, log_gain: Gains, folder: Path) -> list[StationShown]:
    """Pictures into `folder`/maps, of up to MOST_SHOWN stations their maps, of MOST_VIEWED views besides, as paths
    relative to `folder`. `maps` is a folder as that of `Panoramas`, `log_gain` each station's light by channel.

    Guarantees: memory does not go by the number of stations.
    """
    with PackedFile(packed) as opened:
        scene = opened.load()
    n = len(log_gain)
    seen = [_points_of(m, log_gain[i]) for i in even_choice(n, MOST_SEEN) if (m := read_map(maps, i)) is not None]
    if not seen:
        return []
    points, colors = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    renderer = Renderer(antialias=USUAL)
    textured, flat = GpuScene(scene, renderer.context), GpuScene(without_maps(scene), renderer.context)
    viewed, found = set(even_choice(n, MOST_VIEWED)), []
    for i in even_choice(n, MOST_SHOWN):
        station_map = read_map(maps, i)
        if station_map is None:
            continue
        views = []
        for view in _views(scene, station_map) if i in viewed else ():
            pictures = {"flat": renderer.render(flat, view, max_atoms=0), "textured": renderer.render(textured, view)}
            views.append(_compared(view, pictures, seen_points(view, points), colors, folder))
        found.append(_shown(station_map, log_gain[i], tuple(views), folder))
    textured.release()
    flat.release()
    return found


def without_maps(scene: PackedScene) -> PackedScene:
    """The same splats, each in its mean colour; of a file without maps itself."""
    arrays = {name: rows for name, rows in scene.arrays.items() if name != "station" and not name.startswith("map_")}
    return PackedScene(replace(scene.header, maps=()), arrays)


def _points_of(station_map: StationMap, log_gain: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Positions (m, 3), absolute, and colours (m, 3) uint8 of a map's texels, evenly among them."""
    texel = np.flatnonzero(station_map.depth != NOTHING)
    texel = texel[:: -(-len(texel) // MOST_POINTS) or 1]
    row, column = np.divmod(texel, station_map.depth.shape[1])
    distance = decode_distances(station_map.depth[row, column], station_map.frame)
    points = station_map.frame.projection.unproject(np.stack([column, row], axis=1) + 0.5, distance)
    return points, _levels(station_map.color[row, column, :3], log_gain)


def _levels(color: np.ndarray, log_gain: tuple[float, float, float]) -> np.ndarray:
    """Colours (..., 3) in the light of all stations."""
    return np.rint(levels_with(log_gain)[color, np.arange(3)]).astype(np.uint8)


def _views(scene: PackedScene, station_map: StationMap) -> list[Camera]:
    """One near and two away."""
    centre, name = station_map.frame.centre, f"station {station_map.frame.station + 1}"
    (near,) = station_views(scene, [centre], VIEW_PX)
    known = station_map.depth[station_map.depth != NOTHING]
    reach = float(decode_distances(np.median(known), station_map.frame)) if len(known) else 1.0
    rotation, views = np.array(near.rotation), [replace(near, name=f"{name}, near")]
    target = np.array(centre) + reach * rotation[2]
    for side, angle in (("left", TURN_DEGREES), ("right", -TURN_DEGREES)):
        cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        eye = target + turn @ (np.array(centre) - target)
        turned = tuple(map(tuple, (rotation @ turn.T).tolist()))
        views.append(replace(near, name=f"{name}, away {side}", centre=tuple(eye.tolist()), rotation=turned))
    return views


def _compared(
    view: Camera, pictures: dict[str, Picture], seen: SeenPoints, colors: np.ndarray, folder: Path
) -> StationView:
    """Over the pixels that both cover."""
    both = np.all([picture.coverage for picture in pictures.values()], axis=0)
    db = {kind: seen.psnr_db(picture.rgb, colors, both) for kind, picture in pictures.items()}
    paths = {kind: f"{FOLDER}/{view.name.replace(', ', '.').replace(' ', '_')}.{kind}.png" for kind in pictures}
    for kind, picture in pictures.items():
        save_picture(folder / paths[kind], on_background(picture.rgb, picture.alpha))
    return StationView(
        camera=view.name,
        flat_db=db["flat"][0],
        textured_db=db["textured"][0],
        points=db["flat"][1],
        pictures=paths,
    )


def _shown(
    station_map: StationMap, log_gain: tuple[float, float, float], views: tuple[StationView, ...], folder: Path
) -> StationShown:
    seen = station_map.color[..., 3] > 0
    picture = upright(on_background(_levels(station_map.color[..., :3], log_gain), seen, NOT_SEEN))
    width = min(MAP_WIDTH_PX, picture.shape[1])
    path = f"{FOLDER}/{name_of(station_map.frame.station)}.jpg"
    save_picture(folder / path, resized(picture, width, round(width / 6)))
    return StationShown(
        station=station_map.frame.station,
        centre=station_map.frame.centre,
        step_degrees=90 / station_map.frame.height_px,
        covered=float(seen.mean()),
        pictures={"map": path},
        views=views,
    )
