import pytest

from renderer.splats.context import gl_context
from renderer.splats.renderer import Renderer
from storage.errors import ResourceExhausted


@pytest.fixture(scope="session")
def renderer():
    try:
        return Renderer(gl_context())
    except ResourceExhausted as error:
        pytest.skip(str(error))
