"""The one place where an OpenGL context is made, and the few GL calls that moderngl lacks.

Headless through EGL: Mesa's llvmpipe on a machine without a GPU, the driver's own EGL on one with. OpenGL 4.5 is asked
for because depth runs from 1 at the near plane to 0 at infinity (glClipControl), in floating point: so scenes of
millimetres and of kilometres keep seven digits of depth with one fixed choice of planes.
"""

from __future__ import annotations

import ctypes

import moderngl

from storage.errors import ResourceExhausted

GL_VERSION = 450
SYSTEM_PACKAGES = "libegl1 libgl1 libgl1-mesa-dri"
_LOWER_LEFT, _ZERO_TO_ONE, _DEPTH_COMPONENT32F = 0x8CA1, 0x935F, 0x8CAC

_COMMANDS_COMPLETE, _FLUSH, _PASSED = 0x9117, 1, (0x911A, 0x911C)  # of fences: already signalled, condition satisfied


def gl_context() -> moderngl.Context:
    """A new headless context, of the calling thread; everything done with it stands inside `with context:`.

    Guarantees: clip-space depth runs over [0, 1]; `context.info`, the driver's limits, is read. Nothing is freed but by
    `release()`: moderngl's own collection frees from whatever thread Python collects in.

    Raises: ResourceExhausted with the packages to install where no context can be made.
    """
    try:
        context = moderngl.create_context(standalone=True, backend="egl", require=GL_VERSION)
        _gl_function("glClipControl", ctypes.c_uint, ctypes.c_uint)(_LOWER_LEFT, _ZERO_TO_ONE)
    except Exception as error:  # moderngl and its loader raise bare Exception, OSError, ImportError and ValueError
        raise ResourceExhausted(
            "OpenGL",
            f"no headless context ({type(error).__name__}: {error})",
            f"OpenGL {GL_VERSION / 100:.1f} on EGL",
            f"install {SYSTEM_PACKAGES} (Debian, Ubuntu), or a driver that brings EGL",
        ) from error
    context.info  # noqa: B018 - moderngl caches it, and reads zeros while the context is not current
    return context


def float_depth_buffer(context: moderngl.Context, size: tuple[int, int]) -> moderngl.Renderbuffer:
    """A depth buffer of 32-bit floats (moderngl itself makes 24-bit integers only)."""
    buffer = context.depth_renderbuffer(size)
    storage = _gl_function("glNamedRenderbufferStorage", ctypes.c_uint, ctypes.c_uint, ctypes.c_int, ctypes.c_int)
    storage(buffer.glo, _DEPTH_COMPONENT32F, *size)
    return buffer


class Fence:
    """A place in the stream of commands of the current context (glFenceSync): whether the GPU has passed it can be
    asked without waiting.

    Made, asked and deleted while its context is current."""

    def __init__(self) -> None:
        make = _gl_function("glFenceSync", ctypes.c_uint, ctypes.c_uint, result=ctypes.c_void_p)
        self._sync = make(_COMMANDS_COMPLETE, 0)

    def passed(self, wait_s: float = 0.0) -> bool:
        """Whether all commands before it are done, waiting for them at most so long."""
        wait = _gl_function("glClientWaitSync", ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint64, result=ctypes.c_uint)
        return wait(self._sync, _FLUSH, int(1e9 * wait_s)) in _PASSED

    def delete(self) -> None:
        _gl_function("glDeleteSync", ctypes.c_void_p)(self._sync)


def _gl_function(name: str, *argument_types, result=None):
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype, egl.eglGetProcAddress.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    address = egl.eglGetProcAddress(name.encode())
    if not address:
        raise OSError(f"the driver has no {name}")
    return ctypes.CFUNCTYPE(result, *argument_types)(address)
