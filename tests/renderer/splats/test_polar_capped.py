"""The shader's projection against the processor's, on the GL context: 0.02 texel there and back, poles and seam
included."""

import moderngl
import numpy as np

from pipeline.cameras.polar_capped import PolarCapped
from renderer.splats.glsl import with_includes
from storage.maps import MOST_MAP_ROWS

HEIGHT = MOST_MAP_ROWS  # the largest that there is: angles of texels are smallest
KERNEL = """#version 430
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Given { vec4 given[]; };
layout(std430, binding = 1) buffer Found { vec4 found[]; };
uniform float height;
%s
void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= uint(given.length())) return;
    vec2 at = project(given[i].xyz, height);
    found[2u * i] = vec4(at, float(chart_of(given[i].xyz)), 0.0);
    found[2u * i + 1u] = vec4(unproject(given[i].w == 0.0 ? at : given[i].xy, height), 0.0);
}
"""


def on_gpu(context, given: np.ndarray) -> np.ndarray:
    """Column, row and chart, and the direction back, (n, 2, 4) float64, of directions (n, 4)."""
    with context:
        program = context.compute_shader(KERNEL % with_includes("polar_capped.glsl"))
        program["height"].value = HEIGHT
        source, target = context.buffer(given.astype(np.float32).tobytes()), context.buffer(reserve=32 * len(given))
        source.bind_to_storage_buffer(0)
        target.bind_to_storage_buffer(1)
        program.run(-(-len(given) // 64))
        context.memory_barrier(moderngl.Context.SHADER_STORAGE_BARRIER_BIT)
        found = np.frombuffer(target.read(), np.float32).reshape(-1, 2, 4).astype(np.float64)
        for resource in (program, source, target):
            resource.release()
    return found


def directions() -> np.ndarray:
    """Of any length: everywhere, about the poles, about the seam, and on the edges of the charts."""
    rng = np.random.default_rng(0)
    every = rng.normal(size=(20_000, 3))
    pole = np.concatenate([rng.normal(0, 10.0 ** rng.uniform(-8, 0, (4000, 1)), (4000, 2)), np.ones((4000, 1))], axis=1)
    seam = np.stack([np.ones(4000), rng.normal(0, 1e-4, 4000), rng.uniform(-1, 1, 4000)], axis=1)
    edge = every[:4000] * [1, 1, 0]
    edge[:, 2] = (
        np.linalg.norm(edge, axis=1) * np.where(rng.random(4000) < 0.5, 1, -1) * (1 + rng.normal(0, 1e-6, 4000))
    )
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return np.concatenate([every, pole, -pole, seam, edge, axes]) * 10.0 ** rng.uniform(-3, 3, (36_006, 1))


def test_shader__projects_to_within_a_50th_of_a_texel_of_the_processor(renderer):
    given = directions().astype(np.float32).astype(np.float64)
    found = on_gpu(renderer.context, np.concatenate([given, np.zeros((len(given), 1))], axis=1))
    camera = PolarCapped((0.0, 0.0, 0.0), HEIGHT)
    expected, _ = camera.project(given)
    off = np.abs(found[:, 0, :2] - expected)
    off[:, 0] = np.minimum(off[:, 0], np.abs(off[:, 0] - 4 * HEIGHT))  # on either side of the seam
    same_chart = (found[:, 0, 2] == 2) == (expected[:, 0] >= 2 * HEIGHT)
    assert same_chart.mean() > 0.95  # a direction on an edge is in either chart
    assert off[same_chart].max() <= 0.02
    back = found[:, 1, :3]
    unit = given / np.linalg.norm(given, axis=1, keepdims=True)
    angle = np.linalg.norm(np.cross(back, unit), axis=1)
    assert (angle * 2 * HEIGHT / np.pi).max() <= 0.02 and ((back * unit).sum(axis=1) > 0).all()
