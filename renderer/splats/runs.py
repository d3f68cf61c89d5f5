"""Runs of cells decoded on the graphics card: a workgroup a group, an invocation a run."""

from __future__ import annotations

from dataclasses import dataclass

import moderngl
import numpy as np

from pipeline.geometry.runs.codes import RunCodes, pitch_of
from renderer.splats.glsl import shader_source

_GROUPS, _STARTS, _START_NORMALS, _STEPS, _CODEBOOK, _POSITIONS, _NORMALS = range(7)


@dataclass
class GpuRuns:
    """The arrays of codes in GPU memory, and room for what is decoded. Of the context's thread."""

    n_cells: int
    n_groups: int
    pitch: np.ndarray
    buffers: list[moderngl.Buffer]
    program: moderngl.ComputeShader

    def decode(self) -> None:
        """Fill the buffers of positions and normals."""
        for binding, buffer in enumerate(self.buffers):
            buffer.bind_to_storage_buffer(binding)
        self.program["pitch"].value = tuple(self.pitch.tolist())
        self.program.run(self.n_groups)

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (n, 3) float32 against the grid's cell (0, 0, 0), in the grid's frame, and octahedral normals (n, 2) int8."""
        position = np.frombuffer(self.buffers[_POSITIONS].read(), np.float32).reshape(-1, 3)
        words = np.frombuffer(self.buffers[_NORMALS].read(), np.uint32)
        return position, np.stack([words & 255, words >> 8 & 255], axis=1).astype(np.uint8).view(np.int8)

    def release(self) -> None:
        for buffer in self.buffers:
            buffer.release()
        self.program.release()


def upload_runs(context: moderngl.Context, codes: RunCodes, size: float) -> GpuRuns:
    """Codes as they are, the groups' tables side by side, and the program. Inside `with context:`."""
    n_groups = len(codes.base)
    groups = np.zeros((n_groups + 1, 5), np.uint32)
    groups[:-1, :3] = codes.base.view(np.uint32)
    groups[:, 3] = [*codes.first_run, len(codes.start)]
    groups[:, 4] = [*codes.first_step, len(codes.step)]
    contents = (groups, codes.start, codes.normal, codes.step, codes.codebook.astype(np.int32))
    buffers = [context.buffer(_whole_words(array)) for array in contents]
    buffers += [context.buffer(reserve=n * codes.n_cells) for n in (12, 4)]
    return GpuRuns(
        codes.n_cells, n_groups, pitch_of(size), buffers, context.compute_shader(shader_source("decode_runs.comp.glsl"))
    )


def _whole_words(array: np.ndarray) -> bytes:
    data = np.ascontiguousarray(array).tobytes()
    return data + bytes(-len(data) % 4 or (4 if not data else 0))
