"""What a wider beam costs and gives: the front that presets are chosen from, and the two figures of the cost model.

    python -m benchmarks.beam WORK_FOLDER [--pursuits omp 2x2 ...] [--patches 8192] [--write] [--json]

The folder is one of `splatpress compress --work` with the default coder. Patches are taken from all of the scan, and
coded with the last dictionary of the folder at the multiplier of its encoding and four times as low and high, so that
each pursuit is compared with OMP at equal bytes of codes. Microseconds are a thread's, the least of the rounds, taken
in turns; `--write` puts the fit of what OMP does not take into pipeline/costs/costs.json, as two costs of the stage
`encode`.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from pipeline.coding.beam.form import beam_of
from pipeline.coding.grid import coefficients
from pipeline.coding.omp import Pursuit
from pipeline.coding.omp_kernels import squared_norms
from pipeline.costs.costs import COSTS, kilos_of
from pipeline.numerics.accuracy import psnr_db
from pipeline.planning.knobs import PURSUITS
from pipeline.stages.texture.atoms import load_atoms
from pipeline.stages.texture.colors import average_colors
from pipeline.texture.patches import centred
from pipeline.texture.resample import PATCH_DIM
from storage.work import arrays

MULTIPLIERS = (4.0, 2.0, 1.0, 0.5, 0.25)  # times the multiplier at hand; the middle one is timed
RUN = 32  # patches that are taken together


def last(work: Path, stage: str) -> Path:
    return max(work.glob(f"{stage}-*"), key=lambda folder: folder.stat().st_mtime)


def sampled(work: Path, n: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (n, 3 size^2) float32 and squared norms (n,) of patches of all of the scan, less their averages."""
    patches, colors = last(work, "resample"), last(work, "colors")
    n_splats = arrays.layout_of(patches, "energy").shape[0]
    starts = np.linspace(0, max(0, n_splats - RUN), max(1, n // RUN)).astype(int)
    rows, energy = [], []
    for start in starts:
        stop = min(n_splats, start + RUN)
        whole = centred(arrays.read(patches, "texel", start, stop), average_colors(colors, start, stop))
        rows.append(coefficients(whole, size))
        energy.append(squared_norms(whole))
    return np.concatenate(rows), np.concatenate(energy)


def measure(work: Path, pursuits: list[str], n: int, multiplier: float, max_atoms: int, rounds: int) -> dict:
    quantised = last(work, "quantise")
    atoms, levels = load_atoms(quantised), arrays.read(quantised, "weight_levels")
    size = round((atoms.dictionary.shape[1] / 3) ** 0.5)
    rows, energy = sampled(work, n, size)
    rest = np.maximum(energy - squared_norms(rows), 0)
    bits = (len(atoms.dictionary) - 1).bit_length() + (levels.shape[1] - 1).bit_length()

    def coded(pursuit: str, factor: float = 1.0) -> Pursuit:
        return atoms.pursue(rows, max_atoms, 0.0, levels, factor * multiplier, pursuit=pursuit)

    curves = {}
    for pursuit in dict.fromkeys(("omp", *pursuits)):
        found = [coded(pursuit, factor) for factor in MULTIPLIERS]
        curves[pursuit] = [
            (f.codes.n_atoms.sum() * bits / 8 / len(rows), psnr_db((f.residual + rest).sum(), len(rows) * PATCH_DIM))
            for f in found
        ]
    taken = _microseconds({pursuit: lambda pursuit=pursuit: coded(pursuit) for pursuit in curves}, rounds, len(rows))
    plain = np.array(curves["omp"])
    result = []
    for pursuit, curve in curves.items():
        n_bytes, db = curve[len(MULTIPLIERS) // 2]
        result.append(
            {
                "pursuit": pursuit,
                "us_a_patch": taken[pursuit],
                "code_bytes_a_splat": n_bytes,
                "psnr_db": db,
                "gain_db": db - float(np.interp(n_bytes, plain[:, 0], plain[:, 1])),
                "bytes_against_omp": n_bytes / float(np.interp(db, plain[:, 1], plain[:, 0])) - 1,
            }
        )
    kilos = kilos_of(len(atoms.dictionary), size)
    return {"patches": len(rows), "indices": len(atoms.dictionary), "atom_size": size, "kilos": kilos, "rows": result}


def _microseconds(works: dict, rounds: int, n: int) -> dict[str, float]:
    least = dict.fromkeys(works, np.inf)
    for _ in range(rounds):
        for name, work in works.items():
            begun = time.process_time()
            work()
            least[name] = min(least[name], time.process_time() - begun)
    return {name: 1e6 * s / n for name, s in least.items()}


def fitted(found: dict) -> dict[str, float]:
    """What a beam takes beside OMP's time: so much a node and kilo of indices, so much a child."""
    plain = next(row["us_a_patch"] for row in found["rows"] if row["pursuit"] == "omp")
    beams = [(beam_of(row["pursuit"]), row["us_a_patch"] - plain) for row in found["rows"] if row["pursuit"] != "omp"]
    terms = np.array([[beam.width * found["kilos"], beam.width * beam.candidates] for beam, _ in beams])
    node, child = np.linalg.lstsq(terms, np.array([extra for _, extra in beams]), rcond=None)[0]
    return {"task_us_a_unit_a_node_a_kilo": max(0.0, float(node)), "task_us_a_unit_a_child": max(0.0, float(child))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--pursuits", nargs="+", default=list(PURSUITS))
    parser.add_argument("--patches", type=int, default=8192)
    parser.add_argument(
        "--multiplier", type=float, default=0.1, help="squared error that an atom must mend; 0.1: of `balanced`"
    )
    parser.add_argument("--max-atoms", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = measure(
        options.work, options.pursuits, options.patches, options.multiplier, options.max_atoms, options.rounds
    )
    found["fit"] = fitted(found)
    if options.write:
        costs = json.loads(COSTS.read_text())
        costs["stages"]["encode"] |= found["fit"]
        COSTS.write_text(json.dumps(costs, indent=1) + "\n")
    if options.json:
        print(json.dumps(found))
        return
    print(f"{found['patches']} patches, {found['indices']} indices of {found['atom_size']}x{found['atom_size']} texels")
    for row in found["rows"]:
        print(
            f"{row['pursuit']:>5} {row['us_a_patch']:7.1f} us a patch {row['code_bytes_a_splat']:6.2f} bytes of codes a splat "
            f"{row['psnr_db']:6.2f} dB, {row['gain_db']:+.2f} dB at equal bytes, {100 * row['bytes_against_omp']:+.1f} % at equal dB"
        )
    print(f"beside OMP: {found['fit']}")


if __name__ == "__main__":
    main()
