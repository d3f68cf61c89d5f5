"""Numbers of splats over quadrics as shaders read them: bit by bit what the processor decodes."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.splats.decoded import scene_normal_codes
from renderer.splats.glsl import with_includes
from renderer.splats.scene import GpuScene
from storage.packed.packed import PackedScene
from storage.packed.quadrics import frame_sizes
from storage.packed.schema import CHUNK, GROUP
from tests.packed_files import Case, arrays_for, header_of

FOUND = 15  # a binding that no shader of the product has
READ = """
layout(local_size_x = 64) in;
layout(std430, binding = 15) buffer Found { ivec4 found[]; };

void main() {
    uint splat = gl_GlobalInvocationID.x;
    if (splat >= scene.n_splats) return;
    ivec3 normal;
    uint size, cell = read_number(splat, normal, size);
    found[splat] = ivec4(normal.xy, int(size) << 1 | int(normal.z < 0), int(cell));
}
"""


def read_by_shader(context, scene: PackedScene) -> tuple[np.ndarray, np.ndarray]:
    """Normals' first two numbers, codes of sizes above the sign of the third (n, 3), and cells (n,) of all splats."""
    n = scene.header.n_splats
    gpu_scene = GpuScene(scene, context)
    with context:
        heads = [f"#define {name} {value}" for name, value in gpu_scene.defines.items() if value]
        parts = [with_includes(name) for name in ("view.glsl", "splat_geometry.glsl")]
        shader = context.compute_shader("\n".join(["#version 430", *heads, *parts, READ]))
        buffer = context.buffer(reserve=16 * n)
        gpu_scene.bind()
        buffer.bind_to_storage_buffer(FOUND)
        shader.run(-(-n // 64))
        found = np.frombuffer(buffer.read(), np.int32).reshape(n, 4)
        for resource in (shader, buffer):
            resource.release()
    gpu_scene.release()
    return found[:, :3], found[:, 3].view(np.uint32)


@pytest.mark.parametrize(
    "case",
    [
        Case(n_splats=GROUP + 300, n_dictionary=0, atom_counts=(0,), quadrics=True),
        Case(n_splats=GROUP + 300, atom_counts=(0, 1, 2, 3, 4, 5), cliplines=True, size_bits=3, quadrics=True),
        Case(n_splats=1, n_dictionary=0, atom_counts=(0,), quadrics=True),
    ],
    ids=["one batch", "many batches", "one splat"],
)
def test_shader__reads_the_numbers_that_the_processor_does(case, renderer):
    scene = PackedScene(header_of(case), arrays_for(case, header_of(case)))
    normal, cell = read_by_shader(renderer.context, scene)
    steps = (scene.arrays["normal_cells"].astype(np.uint64) + np.uint64(1)).prod(axis=1) * frame_sizes(scene.arrays)
    assert (cell == scene.numbers // steps[np.arange(case.n_splats) // CHUNK]).all()
    codes, size = scene_normal_codes(scene), scene.size_codes.astype(int)
    assert (normal == np.stack([*codes.T[:2], size << 1 | (codes[:, 2] < 0)], axis=1)).all()
    assert case.size_bits == 0 or set(size.tolist()) == set(range(16))
