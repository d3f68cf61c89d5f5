"""Runs of cells decoded on the graphics card: a workgroup a section, an invocation a run."""

from __future__ import annotations

from dataclasses import dataclass

import moderngl
import numpy as np

from pipeline.geometry.runs.codes import pitch_of
from pipeline.geometry.runs.starts import pack_starts
from pipeline.splats.runs import codes_of, places_of
from renderer.splats.glsl import shader_source
from storage.packed.scene import PackedScene
from storage.packed.schema import CHUNK

SPLAT_BYTES = 16  # of a decoded splat: x, y, z as floats, a word of normal
_SPLATS = 4  # binding; before it sections, starts, steps, codebook, after it places


@dataclass
class GpuRuns:
    """The arrays of a packed file's runs in GPU memory, and room for what is decoded. Of the context's thread."""

    n_sections: int
    pitch: np.ndarray
    turn: tuple[float, ...]
    buffers: list[moderngl.Buffer]
    program: moderngl.ComputeShader

    @property
    def splats(self) -> moderngl.Buffer:
        """SPLAT_BYTES a splat, in the file's order."""
        return self.buffers[_SPLATS]

    @property
    def coded_bytes(self) -> int:
        """What the coded arrays take, without the room for what is decoded."""
        return sum(buffer.size for i, buffer in enumerate(self.buffers) if i != _SPLATS)

    def decode(self) -> None:
        """Fill `splats`."""
        for binding, buffer in enumerate(self.buffers):
            buffer.bind_to_storage_buffer(binding)
        self.program["pitch"].value = tuple(self.pitch.tolist())
        for i, name in enumerate(("turn_x", "turn_y", "turn_z")):
            self.program[name].value = self.turn[3 * i : 3 * i + 3]
        self.program.run(self.n_sections)

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (n, 3) float32 against the origin and octahedral normals (n, 2) int8 of all splats."""
        words = np.frombuffer(self.splats.read(), np.uint32).reshape(-1, 4)
        normal = np.stack([words[:, 3] & 255, words[:, 3] >> 8 & 255], axis=1).astype(np.uint8).view(np.int8)
        return words[:, :3].copy().view(np.float32), normal

    def release(self) -> None:
        for buffer in self.buffers:
            buffer.release()
        self.program.release()


def upload_runs(context: moderngl.Context, scene: PackedScene) -> GpuRuns:
    """The runs as they are packed, the sections' tables side by side, and the program. Inside `with context:`."""
    codes, grid = codes_of(scene), scene.header.runs
    assert grid is not None
    starts = pack_starts(codes)
    contents = (starts.sections, starts.words, codes.step, codes.codebook.astype(np.int32))
    buffers = [context.buffer(_whole_words(array)) for array in contents]
    buffers.append(context.buffer(reserve=SPLAT_BYTES * scene.header.n_splats))
    by_place = int("run_batch" in scene.arrays)
    if by_place:
        buffers.append(context.buffer(_whole_words((places_of(scene) % CHUNK).astype(np.uint8))))
    program = context.compute_shader(shader_source("decode_runs.comp.glsl", BY_PLACE=by_place))
    return GpuRuns(len(codes.base), pitch_of(grid.cell), grid.turn, buffers, program)


def _whole_words(array: np.ndarray) -> bytes:
    data = np.ascontiguousarray(array).tobytes()
    return data + bytes(-len(data) % 4 or (4 if not data else 0))
