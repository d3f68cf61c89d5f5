"""What coding the patches of station maps costs a picture: atoms against the patches themselves.

    python -m benchmarks.station_patches SCAN [--station x,y,z] [--density 0.1] [--preset balanced] [--target-psnr-db X]
        [--max-atoms N]

The patches themselves are a packed file whose dictionary has an atom a splat, 32x32 texels of the patch less its average
colour, in 8 bits to the patch's own largest value. Both files, and one colour a splat, are compared with a picture of
all points from the views of `benchmarks.station_maps`.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.station_maps import compared, views_of
from pipeline.coding.quantise import mip_levels
from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import Settings, settings_for
from pipeline.stages.texture.colors import average_colors
from pipeline.stages.texture.texels import texel_pieces
from pipeline.summaries import CodesMade, Quantised
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from services.cli.commands.running import progress_bars
from services.flow.asked import prepare_asked
from services.flow.code import code
from services.flow.pack import pack
from services.flow.run import Run
from services.flow.textures import Coded
from storage.packed.packed import PackedFile, PackedScene
from storage.packed.schema import MIP_SIZES, PATCH_SIZE
from storage.work import arrays

MOST = 1 << 16  # atoms of a packed file


def uncoded(coded: Coded, n_splats: int, folder: Path, weight_bits: int) -> Coded:
    """The same splats, each with its patch for its only atom."""
    if n_splats > MOST:
        raise SystemExit(f"{n_splats:,} splats; allowed: at most {MOST:,}, by a lower --density")
    texels, scale = np.empty((n_splats, PATCH_SIZE, PATCH_SIZE, 3), np.int8), np.empty(n_splats, np.float32)
    average = average_colors(coded.colors.folder, 0, n_splats)
    for start, piece in texel_pieces(coded.patches.folder, 0, n_splats, 1024):
        rows = slice(start, start + len(piece))
        off = piece.reshape(len(piece), -1, 3).astype(np.float32) - average[rows, None]
        largest = np.maximum(np.abs(off).max(axis=(1, 2)), 1e-3)
        texels[rows] = np.rint(off * (127 / largest[:, None, None])).reshape(-1, PATCH_SIZE, PATCH_SIZE, 3)
        scale[rows] = largest / 127 / 255
    dictionary, codes = folder / "dictionary", folder / "codes"
    contents = {"atom_scale": scale, "weight_levels": np.ones((1, 2**weight_bits), np.float32)}
    contents |= {f"atoms_{size}": level for size, level in zip(MIP_SIZES, mip_levels(texels.reshape(n_splats, -1)))}
    for name, rows_ in contents.items():
        arrays.store(dictionary, name, rows_, (4096, *rows_.shape[1:]))
    of_splats = {"n_atoms": np.ones(n_splats, np.uint8), "atom": np.arange(n_splats, dtype=np.uint16)[:, None]}
    for name, rows_ in (of_splats | {"weight_code": np.zeros((n_splats, 1), np.uint8)}).items():
        arrays.store(codes, name, rows_, (arrays.BLOCK, *rows_.shape[1:]))
    assert coded.quantised is not None
    return replace(
        coded,
        codes=replace(coded.codes, folder=codes, summary=CodesMade(None, None, (0, n_splats), 1.0)),
        quantised=replace(coded.quantised, folder=dictionary, summary=Quantised(n_splats, PATCH_SIZE, 1, 0.0)),
        n_dictionary=n_splats,
    )


def loaded(path: Path) -> PackedScene:
    with PackedFile(path) as packed:
        return packed.load()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--station", default="")
    parser.add_argument("--density", type=float, default=0.1)
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--target-psnr-db", type=float)
    parser.add_argument("--max-atoms", type=int)
    options = parser.parse_args()
    asked = settings_for(options.preset, density=options.density, texture="atoms", station=options.station)
    knobs = {name: getattr(options, name) for name in ("target_psnr_db", "max_atoms")}
    asked = replace(asked, **{name: value for name, value in knobs.items() if value is not None})
    scenes: dict[str, PackedScene] = {}
    with tempfile.TemporaryDirectory() as name, SerialExecutor() as executor:
        run = Run(Path(name) / "work", executor, progress_bars())

        def made(words: str, settings: Settings, of: Coded | None) -> None:
            pack(run, prepared, of, settings, words, Path(name) / words)
            scenes[words] = loaded(Path(name) / words)
            print(f"{words}: {(Path(name) / words).stat().st_size / 1e3:,.0f} kB")

        flat = replace(asked, texture="color", density=1.0)
        prepared = prepare_asked(run, options.scan, flat)
        made("all points", flat, None)
        prepared = prepare_asked(run, options.scan, asked)
        made("one colour", asked, None)
        coded = code(run, prepared, asked)
        print(f"texture of atoms: {coded.codes.summary.texture_psnr_db:.2f} dB")
        made("atoms", asked, coded)
        n_splats = prepared.splats.summary.n_splats
        made("patches", asked, uncoded(coded, n_splats, Path(name), asked.weight_bits))
        station = np.array(prepared.scan.summary.stations[0])
    renderer = Renderer()
    drawn = {words: GpuScene(scene, renderer.context) for words, scene in scenes.items()}
    print(f"{'view':14}" + "".join(f"{words:>14}" for words in list(drawn)[1:]) + "   loss by coding")
    for view in views_of(scenes["all points"], station, lambda c: renderer.render(drawn["all points"], c)):
        full = renderer.render(drawn["all points"], view.camera)
        found = [compared(renderer.render(drawn[words], view.camera), full)["psnr_db"] for words in list(drawn)[1:]]
        if None in found:
            print(f"{view.name:14} shows nothing of it")
            continue
        figures = "".join(f"{db:11.2f} dB" for db in found)
        print(f"{view.name:14}{figures}{found[2] - found[1]:14.2f} dB", flush=True)


if __name__ == "__main__":
    main()
