"""The quality report as data: what the packed file itself tells, what the run recorded, what the views showed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from pipeline.effects.plan.request import OFF, asked_by
from renderer.files import strict, write_json
from renderer.report.document import AtomsUsed, Report, RunRecord, Sizes, ViewMeasured
from storage.packed.groups import FIRST_WORDS
from storage.packed.layout import bytes_on_gpu
from storage.packed.packed import PackedScene
from storage.packed.schema import BY_NAME, Camera, Header, atom_arrays
from storage.packed.totals import Totals

REPORT_NAME = "report.json"
GPU_PARTS = ("geometry", "codes", "colors", "dictionary", "maps")
OF_STARTS = dict.fromkeys(("run_sections", "run_starts"), "geometry")  # pipeline/geometry/runs/starts.py
SOURCE_BYTES_PER_PIXEL = 4  # three channels, times 4/3 for the mip levels


def build_report(
    scene: PackedScene,
    file_bytes: int,
    record: RunRecord = RunRecord(),
    views: Sequence[ViewMeasured] = (),
    totals: Totals | None = None,
) -> Report:
    """The report of one packed scene, or of a file with these totals; docs of each figure stand in `sizes_of` and
    `atoms_of`.

    `file_bytes` is the length of the packed file on disk, `record` what its run knows, `views` what
    `renderer.evaluate.previews` returned.

    Guarantees: what was not measured is None or empty, never a guess; nothing is NaN or infinite.
    """
    header, known = totals.header if totals else scene.header, msgspec.to_builtins(record)
    splats = totals.splats if totals else scene.arrays["batch_count"].sum(axis=0, dtype=np.int64)
    sizes = sizes_from(totals.header, totals.bytes, file_bytes) if totals else sizes_of(scene, file_bytes)
    of_run = known["scan"]
    warnings = of_run.pop("warnings")
    scan = _scan_of(header) | {"unit": header.unit, "n_cameras": len(header.cameras)} | of_run
    return msgspec.convert(
        strict(
            {
                "scan": scan,
                "splats": header.n_splats,
                "radius": header.radius,
                "sizes": msgspec.to_builtins(sizes),
                "quality": known["quality"] | {"views": msgspec.to_builtins(list(views))},
                "atoms": msgspec.to_builtins(atoms_of(header, splats)),
                "learning": known["learning"],
                "numerics": known["numerics"] | {"accumulation": _accumulation(header, views)},
                "stages": known["stages"],
                "settings": record.settings or header.settings,
                "estimate": known["estimate"],
                "effects": known["effects"],
                "edges": known["edges"],
                "stations": known["stations"],
                "runs": known["runs"],
                "pages": known["pages"],
                "programs": sorted({name for view in views for name in view.programs}),
                "warnings": warnings,
                **({"found": known["found"]} if "found" in known else {}),
            }
        ),
        Report,
    )


def _scan_of(header: Header) -> dict:
    """What a packed file says of its scan; None where it does not, or not rightly."""
    kinds: dict[str, type] = {"name": str, "format": str, "n_points": int}
    return {name: value if isinstance(value := header.scan.get(name), kind) else None for name, kind in kinds.items()}


def _accumulation(header: Header, views: Sequence[ViewMeasured]) -> str | None:
    found = accumulation_of(views)
    return f"{found}, as asked for" if found and asked_by(header.settings)["accumulation"] == OFF else found


def accumulation_of(views: Sequence[ViewMeasured]) -> str | None:
    """What the colours of the pictures were added up in: the widest that any of them called for."""
    return max((view.accumulation for view in views if view.accumulation), default=None)


def sizes_of(scene: PackedScene, file_bytes: int) -> Sizes:
    """Bytes by part and the compression factors, as Table 1 of the paper counts them.

    - `geometry_bytes`, `codes_bytes`, `colors_bytes`, `dictionary_bytes`, `maps_bytes`: the arrays of each
      part of `storage.packed.schema`, uncompressed, which is what a GPU takes (pictures of maps as textures); `arrays`
      has them one by one.
    - `gpu_bytes`: their sum. The camera of each splat (`provenance_bytes`) is not among them: no shader reads it.
    - `shipped_bytes`: of these, atoms that ship with the program, which no file holds.
    - `file_bytes`: the packed file on disk, where zarr has compressed the arrays once more.
    - `bytes_per_splat`: gpu_bytes / splats.
    - `own_bytes_per_splat`, `own_factor_total`, `own_factor_texture`: as those without `own`, of gpu_bytes -
      shipped_bytes: what this scan adds to the atoms that any scan may share.
    - `source_texture_bytes`: the photographs as a renderer would hold them, RGB8 with mip levels (LOD 0 of Table 1):
      the sum of width * height * 3 * 4/3.
    - `compression_factor_texture`: source_texture_bytes / (codes + colors + dictionary + maps).
    - `compression_factor_total`: (geometry_bytes + source_texture_bytes) / gpu_bytes. The geometry is quantised on
      both sides, so this factor shows what the textures alone give to the whole.

    The factors are None where a scan has no photographs. Table 1 adds 2 bytes a splat to its originals, the index
    of the photograph; here they are left out, which makes both factors smaller, by 1 % there.

    References: HPG 2021, section 4 and Table 1.
    """
    arrays = {
        name: bytes_on_gpu(scene.header, BY_NAME[name], a.nbytes) if name in BY_NAME else int(a.nbytes)
        for name, a in scene.arrays.items()
    }
    if "splat_word" in arrays:
        arrays["splat_word"] = 20 * scene.header.n_groups  # with what origins of each group count in
        del arrays["frame_box"]
    if scene.header.runs:
        arrays = _as_runs_are_uploaded(scene, arrays)
    return sizes_from(scene.header, arrays, file_bytes)


def sizes_from(header: Header, arrays: dict[str, int], file_bytes: int) -> Sizes:
    """As `sizes_of`, of the bytes of each array as a GPU takes it."""
    part_of = OF_STARTS | FIRST_WORDS | {name: array.part for name, array in BY_NAME.items()}
    part = {p: sum(size for name, size in arrays.items() if part_of[name] == p) for p in (*GPU_PARTS, "provenance")}
    gpu_bytes = sum(part[p] for p in GPU_PARTS)
    source = source_texture_bytes(header.cameras)
    shipped = sum(arrays[name] for name in atom_arrays(header)) if header.shipped else 0

    def factors(n_bytes: int) -> tuple[float | None, float | None]:
        """Of the whole and of the textures, where all parts take so much."""
        return (
            (None, None)
            if source is None
            else ((part["geometry"] + source) / n_bytes, source / (n_bytes - part["geometry"]))
        )

    total, texture = factors(gpu_bytes)
    own_total, own_texture = factors(gpu_bytes - shipped)
    return Sizes(
        **{f"{name}_bytes": size for name, size in part.items()},
        gpu_bytes=gpu_bytes,
        file_bytes=int(file_bytes),
        bytes_per_splat=gpu_bytes / header.n_splats,
        source_texture_bytes=source,
        compression_factor_total=total,
        compression_factor_texture=texture,
        arrays=arrays,
        shipped_bytes=shipped,
        own_bytes_per_splat=(gpu_bytes - shipped) / header.n_splats,
        own_factor_total=own_total,
        own_factor_texture=own_texture,
    )


def _as_runs_are_uploaded(scene: PackedScene, arrays: dict[str, int]) -> dict[str, int]:
    """Bytes by array with those of OF_STARTS in the place of what they are made of."""
    from pipeline.geometry.runs.starts import pack_starts  # compiles loops: for runs alone
    from pipeline.splats.runs import codes_of

    starts = pack_starts(codes_of(scene))
    made_of = ("run_base", "run_first", "run_start", "run_normal", "run_section")
    kept = {name: size for name, size in arrays.items() if name not in made_of}
    return kept | {"run_sections": int(starts.sections.nbytes), "run_starts": int(starts.words.nbytes)}


def source_texture_bytes(cameras: Sequence[Camera]) -> int | None:
    """All photographs as RGB8 with mip levels, the paper's LOD 0; None without photographs.

    The paper's own 441 photographs of 3680 x 2456 pixels make the 15.94 GB of its Table 1:

    >>> paper = Camera("", 3680, 2456, 1, 1, 0, 0, (), ())
    >>> round(source_texture_bytes([paper] * 441) / 1e9, 2)
    15.94
    """
    if not cameras:
        return None
    return sum(camera.width_px * camera.height_px for camera in cameras) * SOURCE_BYTES_PER_PIXEL


def atoms_of(header: Header, splats: np.ndarray) -> AtomsUsed:
    """How many splats have 0, 1 ... `n_ranks` atoms (`histogram`), and the `mean`; of the `splats` of each batch."""
    n_atoms = [batch.n_atoms for batch in header.batches]
    histogram = np.bincount(n_atoms, weights=splats, minlength=header.n_ranks + 1).astype(np.int64)
    return AtomsUsed(tuple(histogram.tolist()), float(histogram @ np.arange(len(histogram)) / histogram.sum()))


def as_json(report: Report) -> dict:
    """The report as report.json has it."""
    return strict(msgspec.to_builtins(report))


def write_report(folder: Path, report: dict) -> Path:
    """Write `report.json` into a folder; it appears whole, and it is strict JSON."""
    path = Path(folder) / REPORT_NAME
    write_json(path, report)
    return path
