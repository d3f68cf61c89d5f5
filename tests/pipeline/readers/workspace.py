"""A tiny COLMAP workspace on disk: a textured plane at z = 0, seen by a few cameras from z < 0.

Everything in it is known in closed form: `texture` gives the colour of any point, `render_photo` the photo of any
camera, and every camera sees every point. Tests break it by editing the files.
"""

from __future__ import annotations

import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pycolmap

DISTANCE = 3.0
FOCAL_PX = 60.0


@dataclass(frozen=True)
class Workspace:
    path: Path
    position: np.ndarray  # (n, 3) float32
    normal: np.ndarray  # (n, 3) float32
    color: np.ndarray  # (n, 3) uint8
    names: tuple[str, ...]  # photos in the order of the visibility lists
    visible: tuple[tuple[int, ...], ...]  # positions in `names` for each point


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:  # (..., 3) uint8
    """Smooth waves, so that small errors of position give small errors of colour."""
    waves = [np.sin(3 * x + 1), np.sin(2 * y - x), np.cos(3 * y + 2 * x)]
    return np.rint(127.5 + 100 * np.stack(waves, axis=-1)).astype(np.uint8)


def centre_of(i: int, n_cameras: int) -> np.ndarray:  # (3,)
    return np.array([0.6 * (i - (n_cameras - 1) / 2), 0.2 * i, -DISTANCE])


def render_photo(camera: pycolmap.Camera, centre: np.ndarray) -> np.ndarray:  # (height, width, 3) uint8
    """What the camera, turned as the world is, sees of the plane."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.asarray(camera.cam_from_img(np.stack([u.ravel(), v.ravel()], axis=1)))[:, :2]
    x, y = (centre[:2] - rays * centre[2]).T
    return texture(x, y).reshape(camera.height, camera.width, 3)


def write_photo(path: Path, pixels: np.ndarray, sample: str = "uint8") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], sample)
    if pixels.shape[2] in (2, 4):
        spec.alpha_channel = pixels.shape[2] - 1
        spec.attribute("oiio:UnassociatedAlpha", 1)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec) and out.write_image(pixels), out.geterror()
    out.close()


def write_ply(path: Path, position: np.ndarray, normal: np.ndarray, color: np.ndarray) -> None:
    columns = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("nx", "f4"), ("ny", "f4"), ("nz", "f4")]
    columns += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    rows = np.empty(len(position), [(name, "<" + kind) for name, kind in columns])
    for (name, _), values in zip(columns, [*position.T, *normal.T, *color.T], strict=True):
        rows[name] = values
    types = {"f4": "float", "u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", "comment tiny plane", f"element vertex {len(rows)}"]
    lines += [f"property {types[kind]} {name}" for name, kind in columns] + ["end_header", ""]
    path.write_bytes("\n".join(lines).encode() + rows.tobytes())


def write_vis(path: Path, visible: tuple[tuple[int, ...], ...]) -> None:
    lists = b"".join(struct.pack(f"<I{len(v)}I", len(v), *v) for v in visible)
    path.write_bytes(struct.pack("<Q", len(visible)) + lists)


def _model(camera: pycolmap.Camera, names: list[str], image_ids: list[int]) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    for i, (name, image_id) in enumerate(zip(names, image_ids, strict=True)):
        image = pycolmap.Image(name=name, keypoints=np.full((5, 2), 7.0), camera_id=1, image_id=image_id)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), -centre_of(i, len(names)))
        model.add_image_with_trivial_frame(image, pose)
    return model


def write_workspace(
    path: Path,
    *,
    n_cameras: int = 3,
    n_side: int = 12,
    model: str = "PINHOLE",
    params: tuple[float, ...] = (),
    ending: str = ".bin",
    image_ids: tuple[int, ...] = (),
    photo_suffix: str = ".png",
    size_px: tuple[int, int] = (64, 48),
) -> Workspace:
    """Writes the workspace; `params` are those of a camera `model` other than PINHOLE."""
    width, height = size_px
    params = params or (FOCAL_PX, FOCAL_PX, width / 2, height / 2)
    camera = pycolmap.Camera(model=model, width=width, height=height, params=list(params), camera_id=1)
    names = [f"{i:04d}{photo_suffix}" for i in range(n_cameras)]
    ids = list(image_ids) or list(range(1, n_cameras + 1))
    reconstruction = _model(camera, names, ids)
    (path / "sparse").mkdir(parents=True)
    (reconstruction.write_binary if ending == ".bin" else reconstruction.write_text)(str(path / "sparse"))
    for i, name in enumerate(names):
        write_photo(path / "images" / name, render_photo(camera, centre_of(i, n_cameras)))

    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.8, 0.8, n_side), np.linspace(-0.6, 0.6, n_side)))
    position = np.stack([x, y, np.zeros_like(x)], axis=1).astype(np.float32)
    normal = np.broadcast_to(np.float32([0, 0, -1]), position.shape)
    color = texture(x, y)
    # A different number of cameras for neighbours, none for every fourth point.
    visible = tuple(tuple(range(i % (n_cameras + 1))) for i in range(len(position)))
    write_ply(path / "fused.ply", position, normal, color)
    write_vis(path / "fused.ply.vis", visible)
    by_id = dict(zip(ids, names, strict=True))
    in_order = tuple(by_id[i] for i in sorted(ids))  # pycolmap writes frames by rising id
    return Workspace(path, position, normal, color, in_order, visible)


def zip_folder(folder: Path, target: Path, wrap: str = "") -> Path:
    """The folder as a .zip, its members below `wrap`."""
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, wrap + file.relative_to(folder).as_posix())
    return target
