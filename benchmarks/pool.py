"""A file with levels drawn through a pool of groups, beside the whole file in memory and its finest level alone.

    python -m benchmarks.pool PACKED [--mib 64] [--away 1,4,16] [--size 1280x720]

Four views around the scan from so many times the distance at which it fills the picture: PSNR of the pool's picture to
the whole file's by the same detail, MiB in the pool, groups read so far, and processor seconds of drawing (the finest
level, the whole file, the pool once it rests).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from renderer.evaluate.compare import psnr_db
from renderer.residency.pooled import PooledFile
from renderer.splats.detail import FINEST, Detail
from renderer.splats.renderer import Picture, Renderer
from renderer.splats.scene import GpuScene
from renderer.splats.views import bulk_of, framed_views
from storage.packed.packed import PackedFile


def timed(draw: Callable[[], Picture]) -> tuple[Picture, float]:
    """A picture, and the processor seconds that it took."""
    begun = time.process_time()
    return draw(), time.process_time() - begun


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("packed", type=Path)
    parser.add_argument("--mib", type=float, default=64)
    parser.add_argument("--away", default="1,4,16")
    parser.add_argument("--size", default="1280x720")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    renderer = Renderer()
    with PackedFile(options.packed) as packed:
        scene = packed.load()
        whole = GpuScene(scene, renderer.context)
        pooled = PooledFile(packed, renderer.context, int(options.mib * (1 << 20)))
        print(f"{packed.header.n_splats:,} splats of levels {packed.header.levels}, {packed.header.n_groups} groups of")
        print(
            f"{pooled.place_bytes:,} bytes at most, a pool of {pooled.n_pool}, {whole.total_bytes / (1 << 20):.1f} MiB"
        )
        low, high = bulk_of(scene)
        middle = (low.min(axis=0) + high.max(axis=0)) / 2 + scene.header.origin
        print(
            f"{'away':>6} {'view':<10}{'PSNR':>10}{'detail':>8}{'MiB':>7}{'read':>7}{'finest':>9}{'whole':>9}{'pool':>9}"
        )
        for away in map(float, options.away.split(",")):
            for near in framed_views(scene, 4, (width, height)):
                view = replace(near, centre=tuple((middle + away * (np.array(near.centre) - middle)).tolist()))
                pooled.render(renderer, view)
                found, pool_s = timed(lambda: pooled.render(renderer, view))  # noqa: B023
                detail = Detail(pooled.detail_shown)
                expected, whole_s = timed(lambda: renderer.render(whole, view, detail=detail))  # noqa: B023
                _, finest_s = timed(lambda: renderer.render(whole, view, detail=FINEST))  # noqa: B023
                alike = psnr_db(found.rgb, expected.rgb, np.ones(found.coverage.shape, bool))
                print(
                    f"{away:6g} {view.name:<10}{alike:7.1f} dB{detail.pixels:8.2f}{pooled.n_bytes / (1 << 20):7.1f}"
                    f"{pooled.n_read:7,}{finest_s:8.2f}s{whole_s:8.2f}s{pool_s:8.2f}s"
                )


if __name__ == "__main__":
    main()
