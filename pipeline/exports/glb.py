"""GLB: Gaussians by the extension KHR_gaussian_splatting; programs without it show the points in their colours.

References: Khronos glTF 2.0, section 4 (GLB) and the ratified extension KHR_gaussian_splatting.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.exports.gaussians import Gaussians

EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _USHORT, _POINTS, _VERTICES = 5126, 5123, 0, 34962
_JSON, _BIN = 0x4E4F534A, 0x004E4942


def write(path: Path, gaussians: Gaussians, y_up: Rotation, metres: float, unit: str) -> None:
    """Write `encoded` of them."""
    path.write_bytes(encoded(gaussians, y_up, metres, unit))


def encoded(gaussians: Gaussians, y_up: Rotation, metres: float, unit: str) -> bytes:
    """A GLB in the scan's axes and unit; the node turns them y up and scales them to metres, its extras name the origin."""
    alpha = np.full((len(gaussians), 1), gaussians.opacity)
    color = np.round(65535 * np.concatenate([_to_linear(gaussians.color), alpha], axis=1)).astype("<u2")
    attributes = {
        "POSITION": gaussians.position,
        f"{EXTENSION}:ROTATION": gaussians.rotation,
        f"{EXTENSION}:SCALE": gaussians.sigma,
        f"{EXTENSION}:OPACITY": alpha[:, 0],
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": gaussians.dc,
        "COLOR_0": color,
    }
    views, accessors, blocks, offset = [], [], [], 0
    for values in attributes.values():
        data = values if values is color else np.ascontiguousarray(values, "<f4")
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": data.nbytes, "target": _VERTICES})
        accessors.append(_accessor(data, len(views) - 1))
        blocks.append(data.tobytes())
        offset += data.nbytes
    positions = np.asarray(gaussians.position, np.float32)
    accessors[0] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    primitive = {
        "mode": _POINTS,
        "attributes": dict(zip(attributes, range(len(attributes)), strict=True)),
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    document = {
        "asset": {"version": "2.0", "generator": "splatpress"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {
                "mesh": 0,
                "rotation": y_up.as_quat().tolist(),
                "scale": [metres] * 3,
                "extras": {"origin": list(gaussians.origin), "unit": unit},
            }
        ],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    start = struct.pack("<4s2I", b"glTF", 2, 12 + 8 + len(text) + 8 + offset)
    return b"".join(
        [start, struct.pack("<2I", len(text), _JSON), text, struct.pack("<2I", offset, _BIN), *blocks],
    )


def _accessor(data: np.ndarray, view: int) -> dict:
    kind = "SCALAR" if data.ndim == 1 else f"VEC{data.shape[1]}"
    normalized = {"normalized": True} if data.dtype == np.uint16 else {}
    return {
        "bufferView": view,
        "componentType": _USHORT if normalized else _FLOAT,
        "count": len(data),
        "type": kind,
        **normalized,
    }


def _to_linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
