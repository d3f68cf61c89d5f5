import pytest

from pipeline.catalogue import BY_NAME
from pipeline.stages.beside import work_arrays
from renderer.splats.context import gl_context
from renderer.splats.renderer import Renderer
from storage.errors import ResourceExhausted
from storage.work import arrays, work
from storage.work.schema import not_of_the_table

OF_OTHERS = ("sampled", "pack")  # whose arrays are rows of any other stage's, and those of the packed file


# Kernels are compiled first; then comes what waits for services, the longest files of all before the others; files of
# seconds come last, so that no worker ends long before the others (`make test` deals out files in this order).
ORDER = ("hard_cases", "golden", "pipeline", "services", "renderer", "storage")
LONG = ("compose", "service", "image", "page", "faults", "bucket")


def _place(item) -> tuple[int, bool]:
    _, room, *rest = item.nodeid.partition("::")[0].split("/")
    is_long = room == "services" and rest[-1] in {f"test_{name}.py" for name in LONG}
    return ORDER.index(room) if room in ORDER else len(ORDER), not is_long


def pytest_collection_modifyitems(items):
    items.sort(key=_place)


@pytest.fixture(scope="session")
def renderer():
    try:
        return Renderer(gl_context())
    except ResourceExhausted as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session", autouse=True)
def work_folders_are_of_their_table():
    """Every stage that a test completes in this process has arrays of the table alone; equal sets of names are looked
    at once."""
    complete, table, known = work.complete, work_arrays(), set()

    def checked(folder, *told):
        stage = folder.name.rpartition("-")[0]
        if stage in BY_NAME and stage not in OF_OTHERS and (names := (stage, *arrays.names(folder))) not in known:
            known.add(names)
            assert not_of_the_table(folder, table) == []
        return complete(folder, *told)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(work, "complete", checked)
        yield
