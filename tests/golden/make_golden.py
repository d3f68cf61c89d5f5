"""Golden packed files and the numbers that they decode to; `python -m tests.golden.make_golden` makes all of them.

Until the format is released a change of it makes them anew; from then on they are never made again, for they must
decode for ever.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from pipeline.geometry.frame import tangent_frames
from storage.packed.packed import SUFFIX, PackedFile
from storage.packed.scene import PackedScene
from tests import reference_packed
from tests.packed_files import Case, write_packed_file

HERE = Path(__file__).parent
EXPECTED = HERE / "expected.json"

CASES = {
    "d8w4": Case(),
    "d12w4": Case(dictionary_bits=12, n_dictionary=300),
    "d16w8": Case(dictionary_bits=16, weight_bits=8, n_dictionary=300),
    "no-texture": Case(n_dictionary=0, atom_counts=(0,), n_cameras=0),
    "cliplines": Case(cliplines=True, atom_counts=(0, 2, 5)),
    "two-groups": Case(n_splats=8192 + 130, period=128),
    "oblique": Case(up=(-5, -35, 6), ahead=(1, 5, 30)),
    "ellipsoids": Case(ellipsoids=True, cliplines=True, atom_counts=(0, 2, 5), up=(-5, -35, 6), ahead=(1, 5, 30)),
    "turned-8": Case(dictionary_bits=6, atom_size=8, n_turns=8),
    "small-16": Case(atom_size=16),
    "two-levels": Case(atom_size=16, n_turns=8, coarsest_size=8),
    "color-boxes": Case(atom_size=8, n_turns=8, color_step=100),
    "sixteen-atoms": Case(atom_size=8, n_turns=8, atom_counts=(0, 7, 9, 16), n_ranks=16, color_step=133),
    "sizes": Case(size_bits=3, ellipsoids=True, cliplines=True, atom_counts=(0, 2, 5)),
    "sizes-of-two-bits": Case(size_bits=2, atom_size=8, color_step=100),
    "maps": Case(n_dictionary=0, atom_counts=(0,), n_cameras=0, size_bits=3, n_maps=2),
    "boxes-of-two-groups": Case(
        n_splats=8192 + 130, period=128, n_dictionary=0, atom_counts=(0,), n_cameras=0, color_step=80
    ),
    "runs": Case(n_splats=8192 + 130, period=128, n_dictionary=0, atom_counts=(0,), n_cameras=0, runs=True),
    "quadrics": Case(n_splats=8192 + 130, period=128, n_dictionary=0, atom_counts=(0,), n_cameras=0, quadrics=True),
    "quadrics-of-batches": Case(
        quadrics=True, cliplines=True, ellipsoids=True, size_bits=3, atom_size=8, color_step=100
    ),
    "archive": Case(cliplines=True, size_bits=3, atom_size=8, period=40, archive=True),
    "archive-of-quadrics": Case(
        n_splats=8192 + 130, n_dictionary=0, atom_counts=(0,), n_cameras=0, period=128, quadrics=True, archive=True
    ),
    "shipped": Case(dictionary_bits=12, n_dictionary=512, atom_size=16, n_turns=8, coarsest_size=4, shipped=True),
    "runs-of-batches": Case(runs=True, cliplines=True, ellipsoids=True, size_bits=3, atom_size=8, color_step=100),
}


def golden_file(name: str) -> Path:
    return HERE / (name + SUFFIX)


def decoded_numbers(scene: PackedScene) -> dict:
    """What the arrays hold, by digest, and what a few splats decode to by the slow twins."""
    n = scene.header.n_splats
    chosen = sorted({0, 1, 127, 128, n // 2, n - 2, n - 1})
    digests = {name: hashlib.sha256(values.tobytes()).hexdigest() for name, values in sorted(scene.arrays.items())}
    header = asdict(scene.header) | {"batches": scene.header.to_json()["batches"]}
    return {"header": header, "sha256": digests, "splats": {str(i): _splat_numbers(scene, i) for i in chosen}}


def _splat_numbers(scene: PackedScene, i: int) -> dict:
    u, v, normal = (
        rows[0].tolist()
        for rows in tangent_frames(reference_packed.normal_code(scene, i), scene.header.up, scene.header.ahead)
    )
    patch = reference_packed.decode_patch(scene, i) if scene.header.n_dictionary else np.zeros((32, 32, 3))
    return {
        "radius": reference_packed.decode_radius(scene, i),
        "position": reference_packed.decode_position(scene, i),
        "normal": normal,
        "u": u,
        "v": v,
        **_color_numbers(scene, i),
        "code": reference_packed.decode_code(scene, i),
        "clipline": reference_packed.decode_clipline(scene, i),
        **_ellipsoid_numbers(scene, i),
        "texels": patch[[0, 9, 31], [31, 20, 0]].tolist(),
    }


def _color_numbers(scene: PackedScene, i: int) -> dict:
    if scene.header.color_step:
        return {"color_in_box": reference_packed.decode_color(scene, i)}
    return {"color": scene.arrays["color"][i].tolist()}


def _ellipsoid_numbers(scene: PackedScene, i: int) -> dict:
    axes = reference_packed.decode_ellipsoid(scene, i)
    return {} if axes is None else {"ellipsoid": axes}


def main() -> None:
    expected = {}
    for name, case in CASES.items():
        path = write_packed_file(case, golden_file(name))
        with PackedFile(path) as packed:
            expected[name] = decoded_numbers(packed.load())
    EXPECTED.write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    main()
