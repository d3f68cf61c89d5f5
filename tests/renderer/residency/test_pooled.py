"""A file drawn through a pool of groups: the pictures of the whole in memory, within the bytes that it was given."""

from __future__ import annotations

import numpy as np
import pytest

from renderer.residency.pooled import A_FRAME, PooledFile
from renderer.splats.detail import Detail
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from storage.errors import InvalidScan, ResourceExhausted
from storage.packed.packed import PackedFile
from storage.packed.schema import GROUP, Camera

SIZE = 160


def view_from(distance: float, x: float = 0.5) -> Camera:
    """Down on the surface of a metre from so far above `x`."""
    rotation = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
    return Camera("above", SIZE, SIZE, 200.0, 200.0, SIZE / 2, SIZE / 2, rotation, (x, 0.5, distance))


@pytest.fixture(scope="module")
def file(levelled_files):
    with PackedFile(levelled_files[2]) as packed:
        yield packed


def psnr(a, b) -> float:
    return float(10 * np.log10(255**2 / max(1e-9, np.square(a.rgb.astype(float) - b.rgb).mean())))


def test_pooled__pictures_at_rest_are_those_of_the_whole_file(file):
    renderer = Renderer()
    whole = GpuScene(file.load(), renderer.context)
    place = PooledFile(file, renderer.context, 1 << 30).place_bytes
    pool_bytes = (A_FRAME + 1 + 6) * place  # the coarsest group and 6 more; the file has 23
    pooled = PooledFile(file, renderer.context, pool_bytes)
    for view in (view_from(3.0), view_from(0.12, 0.2), view_from(0.12, 0.8), view_from(0.12, 0.2)):
        found, expected = pooled.render(renderer, view), renderer.render(whole, view)
        assert pooled.detail_shown == 1.0 and pooled.n_bytes <= pool_bytes
        assert psnr(found, expected) > 60 and (found.coverage == expected.coverage).mean() > 0.9999
    assert pooled.n_read > 1 + 6  # they came and went
    wide = pooled.render(renderer, view_from(0.9), detail=Detail(0.0))  # asks for all of the finest level
    assert pooled.detail_shown > 0 and pooled.n_bytes <= pool_bytes
    assert psnr(wide, renderer.render(whole, view_from(0.9), detail=Detail(pooled.detail_shown))) > 60
    pooled.release()
    whole.release()


def test_pooled__far_views_read_no_more_than_the_coarsest_level(file):
    renderer = Renderer()
    pooled = PooledFile(file, renderer.context, 1 << 30)
    pooled.render(renderer, view_from(60.0))
    assert pooled.n_read == file.header.levels[0] // GROUP
    pooled.release()


def test_pooled__a_pool_too_small_and_a_file_without_levels_are_refused(file, levelled_files):
    context = Renderer().context
    with pytest.raises(ResourceExhausted, match="pool of groups"):
        PooledFile(file, context, 100_000)
    with PackedFile(levelled_files[0]) as one, pytest.raises(InvalidScan, match="one level"):
        PooledFile(one, context, 1 << 30)
