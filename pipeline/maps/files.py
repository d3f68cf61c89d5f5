"""Maps as pictures that any image program edits: NAME.color.png (colour and alpha), NAME.depth.png (16 bits),
NAME.json.

Pictures stand upright, as seen from the station: from left to right the band, from azimuth 360 down to 0 degrees, four
squares wide; the top cap; the bottom cap, as looked down on. They are the map turned by half a turn, the bottom cap
mirrored besides: (pipeline/cameras/polar_capped.py). NAME.json has all that turns pixels into directions and distances.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from pipeline.maps.station_map import LAST_CODE, NOTHING, MapFrame, StationMap
from storage.errors import InvalidScan
from storage.whole import whole

COLOR, DEPTH, POSE = ".color.png", ".depth.png", ".json"
ALLOWED = "what `splatpress map` wrote, edited: 8 or 16 bits a channel, RGB or RGBA, of the same size"


def name_of(station: int) -> str:
    """What the files of a station's map begin with."""
    return f"station_{station:03d}"


def upright(picture: np.ndarray) -> np.ndarray:
    """A map (h, 6 h, ...) as a picture."""
    turned = picture[::-1, ::-1].copy()
    turned[:, -picture.shape[0] :] = turned[::-1, -picture.shape[0] :]
    return turned


def from_upright(picture: np.ndarray) -> np.ndarray:
    """The map that a picture shows."""
    turned = picture.copy()
    turned[:, -picture.shape[0] :] = turned[::-1, -picture.shape[0] :]
    return turned[::-1, ::-1].copy()


def write_map(folder: Path, station_map: StationMap, unit: str) -> list[str]:
    """Write the three files of a map; returns their names."""
    name = name_of(station_map.frame.station)
    _write_png(folder / (name + COLOR), upright(station_map.color))
    _write_png(folder / (name + DEPTH), upright(station_map.depth)[..., None])
    with whole(folder / (name + POSE)) as partial:
        partial.write_text(json.dumps(_pose(station_map.frame, unit), indent=2))
    return [name + COLOR, name + DEPTH, name + POSE]


def has_map(folder: Path, station: int) -> bool:
    """Whether a folder has the picture of a station's map."""
    return (folder / (name_of(station) + COLOR)).is_file()


def read_edited(folder: Path, drawn: StationMap) -> StationMap:
    """The map as it was drawn, with the colours and the alpha of its edited picture.

    Colours where nothing was seen have no distance, and are not looked up; where an edit takes alpha away, nothing is
    seen any more. A picture without alpha leaves it as it was.

    Raises: InvalidScan for a picture that cannot be read, of another size, or of another map.
    """
    frame = drawn.frame
    path = folder / (name_of(frame.station) + COLOR)
    _check_pose(folder / (name_of(frame.station) + POSE), frame)
    pixels = _read_png(path, frame)
    color = drawn.color.copy()
    color[..., : pixels.shape[2]] = from_upright(pixels)
    seen = (drawn.depth != NOTHING) & (color[..., 3] > 0)
    color[..., 3] = np.where(seen, 255, 0)
    return StationMap(frame, color, np.where(seen, drawn.depth, np.uint16(NOTHING)))


def _pose(frame: MapFrame, unit: str) -> dict:
    h = frame.height_px
    return frame.to_json() | {
        "unit": unit,
        "step_degrees": 90 / h,
        "size_px": [6 * h, h],
        "axes": "those of the scan, z up",
        "band": f"column c < {4 * h}, row r: azimuth 360 (1 - c / {4 * h}), elevation 90 (1/2 - r / {h}) degrees",
        "caps": f"top {4 * h} <= c < {5 * h}, bottom {5 * h} <= c < {6 * h}; u = 1/2 - (c mod {h}) / {h}, v = 1/2 - r / {h} (bottom: "
        f"r / {h} - 1/2): 90 hypot(u, v) degrees from the pole, azimuth atan2(v, u)",
        "depth": f"distance = nearest (farthest / nearest)^(value / {LAST_CODE}); {NOTHING} where there is none",
    }


def _check_pose(path: Path, frame: MapFrame) -> None:
    try:
        told = json.loads(path.read_text())
        found = (int(told["height_px"]), tuple(float(x) for x in told["centre"]))
    except FileNotFoundError:
        raise InvalidScan(str(path), "missing", "the file that `splatpress map` wrote beside the picture") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InvalidScan(
            str(path), f"{type(error).__name__}: {error}", "the file that `splatpress map` wrote"
        ) from None
    if found[0] != frame.height_px or not np.allclose(found[1], frame.centre, rtol=0, atol=1e-6 * frame.farthest):
        raise InvalidScan(
            str(path), f"a map of {found[0]} rows from {found[1]}", f"{frame.height_px} rows from {frame.centre}",
            "maps of another scan, or of another reading of it: write them again with `splatpress map`",
        )  # fmt: skip


def _write_png(path: Path, pixels: np.ndarray) -> None:
    height, width, n_channels = pixels.shape
    with whole(path, ".png") as partial:
        spec = oiio.ImageSpec(width, height, n_channels, str(pixels.dtype))
        spec.attribute("oiio:UnassociatedAlpha", 1)
        spec.attribute("png:compressionLevel", 3)
        out = oiio.ImageOutput.create(str(partial))
        if not out.open(str(partial), spec) or not out.write_image(np.ascontiguousarray(pixels)) or not out.close():
            raise OSError(f"{path}: {out.geterror() or oiio.geterror()}")


def _read_png(path: Path, frame: MapFrame) -> np.ndarray:
    """(h, 6 h, 3 or 4) uint8, its size looked at before any pixel."""
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # else colours come multiplied by alpha
    file = oiio.ImageInput.open(str(path), config)
    if file is None:
        raise InvalidScan(str(path), f"an unreadable picture ({oiio.geterror().strip() or 'no reason given'})", ALLOWED)
    spec = file.spec()
    found, wanted = (spec.width, spec.height), frame.projection.size
    if found != wanted or spec.nchannels not in (3, 4) or spec.format.basetype not in (oiio.UINT8, oiio.UINT16):
        file.close()
        what = f"{found[0]} x {found[1]} pixels of {spec.nchannels} channels of {spec.format}"
        raise InvalidScan(str(path), what, f"{wanted[0]} x {wanted[1]}, {ALLOWED}")
    pixels = file.read_image(0, 0, 0, spec.nchannels, "uint8")
    damaged, reason = file.has_error, file.geterror()
    file.close()
    if damaged or pixels is None:
        raise InvalidScan(str(path), f"a damaged picture ({reason.strip() or 'no reason given'})", ALLOWED)
    return pixels
