"""The packed file of splats and their codes."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path

from pipeline.effects.depth_margin import LEAST_RADII
from pipeline.effects.mip_levels import stored_sizes
from pipeline.effects.plan.request import ON, parse_request
from pipeline.execution.stage import StageRecord
from pipeline.geometry.frame import directions_of
from pipeline.geometry.sizes import BITS
from pipeline.planning.color_step import color_step
from pipeline.planning.settings import Settings
from pipeline.stages.maps.map_pictures import stored_maps
from pipeline.stages.packed.join import FILE, Join, hand_over, is_joined_by_all
from pipeline.stages.packed.kinds import Kinds, batches_of
from pipeline.stages.packed.pack import Pack
from pipeline.stages.points.grid_counts import IN_MEMORY
from pipeline.summaries import Packed
from services.flow.maps import Mapped
from services.flow.points.runs import RunGeometry
from services.flow.prepare import Prepared
from services.flow.run import Run
from services.flow.textures import Coded
from storage.packed.groups import FIRST_WORDS
from storage.packed.schema import BOXES, BY_NAME, EXTRAS, MOST_SIZES, QUADRICS, RUNS, Header, RunGrid
from storage.packed.writing.joined import seal_packed
from storage.whole import aside
from storage.work import arrays, work


def texels_of_levels(prepared: Prepared, settings: Settings) -> tuple[int, int]:
    """Texels to a side of the finest and of the coarsest mip level that atoms need."""
    plan = prepared.effects
    asked_for = parse_request(settings.effects)["mip_levels"] == ON
    return stored_sizes(
        plan.measured.get("mip_levels"), asked_for, settings.view_distance, "level_blending" in plan.enabled
    )


def _size_bits(prepared: Prepared) -> int:
    """Of a splat's radius; over quadrics at most."""
    if not arrays.exists(prepared.splats.folder, "size_code"):
        return 0
    return BITS if prepared.quadric_error is None else (MOST_SIZES - 1).bit_length()


def _stored_index_bits(coded: Coded | None, settings: Settings) -> int:
    """No more than the indices take; the paper's coder has those of its name."""
    if settings.coder == "paper" and settings.dictionary_bits != "auto":
        return int(settings.dictionary_bits)
    n_indices = coded.n_dictionary * coded.quantised.summary.n_turns if coded and coded.quantised else 1
    return max(1, (n_indices - 1).bit_length())


def _stored_form(coded: Coded | None, coarsest: int) -> dict:
    if coded is None or coded.quantised is None:
        return {}
    found = coded.quantised.summary
    size = found.atom_size
    return {"atom_size": size, "n_turns": found.n_turns, "coarsest_size": min(coarsest, size), "shipped": coded.shipped}


def pack(
    run: Run,
    prepared: Prepared,
    coded: Coded | None,
    settings: Settings,
    name: str,
    path: Path | None,
    mapped: Mapped | None = None,
) -> StageRecord[Packed]:
    """Write the packed file to `path`; None leaves it a folder of the work folder's. Splats are textured by what is
    `coded`, by maps, or by nothing."""
    scan = prepared.scan.summary
    flag_of = {extra.stream: extra.flag for extra in EXTRAS}  # an effect is named as its stream
    extras = tuple((flag_of[name], folder) for name, folder in prepared.built if name in flag_of)
    n_splats = prepared.splats.summary.n_splats
    kinds = n_splats, coded.codes.folder if coded else None, extras
    batches = batches_of(*kinds) if n_splats <= IN_MEMORY else run.do(Kinds(*kinds)).summary.batches
    margin = prepared.effects.outcomes.get("depth_margin", {"margin_radii": LEAST_RADII})["margin_radii"]
    up, ahead = directions_of(scan.cameras)
    header = Header(
        n_splats=n_splats,
        radius=prepared.radius,
        unit=scan.unit,
        origin=prepared.partition.summary.origin,
        up=up,
        ahead=ahead,
        margin_radii=margin,
        levels=levels if len(levels := prepared.partition.summary.levels) > 1 else (),
        size_bits=_size_bits(prepared),
        n_dictionary=coded.n_dictionary if coded else 0,
        dictionary_bits=_stored_index_bits(coded, settings),
        weight_bits=settings.weight_bits,
        **_stored_form(coded, texels_of_levels(prepared, settings)[1]),
        batches=batches,
        effects=prepared.effects.outcomes,
        n_ranks=max([1, *(batch.n_atoms for batch in batches)]),
        color_step=color_step(settings) if coded or mapped else 0,
        maps=stored_maps(mapped.pictures.folder)[1] if mapped else (),
        geometry=RUNS if prepared.runs else BOXES if prepared.quadric_error is None else QUADRICS,
        runs=_run_grid(prepared.runs) if prepared.runs else None,
        cameras=scan.cameras,
        scan={"name": name, "format": scan.format, "n_points": scan.n_read},
        settings=asdict(settings),
    )
    record = run.do(
        Pack(
            header,
            prepared.splats.folder,
            coded.colors.folder if coded else mapped.colors.folder if mapped else None,
            coded.codes.folder if coded else None,
            coded.quantised.folder if coded and coded.quantised else None,
            extras,
            mapped.stations.folder if mapped else None,
            mapped.pictures.folder if mapped else None,
            (prepared.runs.codes.folder, prepared.runs.cells.folder) if prepared.runs else None,
        )
    )
    if path is not None:
        write_packed(run, record, path, settings.archive == "on")
    return record


def write_packed(run: Run, packed: StageRecord[Packed], path: Path, archive: bool = False) -> None:
    """Put what `Pack` made together as one file, in archive form where that is asked for and there is one: none of
    runs."""
    if not archive:
        _put_together(run, packed, path)
        return
    from storage.packed.archive.transcode import archive_packed, has_archive_form  # compiles loops: for archives alone

    with aside(path) as made:
        _put_together(run, packed, made / path.name)
        if has_archive_form(made / path.name):
            archive_packed(made / path.name, path)
        else:
            os.replace(made / path.name, path)


def _put_together(run: Run, packed: StageRecord[Packed], path: Path) -> None:
    """A large file by all workers."""
    if not is_joined_by_all(packed.folder, sum(packed.summary.bytes.values())):
        seal_packed(packed.folder / "packed", path)
        return
    stage = Join(packed.folder)
    folder = work.stage_folder(run.work, stage)
    if work.is_complete(folder) and not (folder / FILE).is_file():  # an earlier job has it
        work.discard(folder)
    hand_over(packed.folder, run.do(stage).folder, path)


def _run_grid(runs: RunGeometry) -> RunGrid:
    grid, codes = runs.grid.summary, runs.codes.summary
    return RunGrid(grid.cell, grid.turn, codes.n_sections, codes.n_runs)


def packed_gpu_bytes(packed: StageRecord[Packed], share: float = 1.0) -> float:
    """Of a scan's splats, or of a sample's, to which a `share` of the dictionary is counted."""
    counted = {"dictionary": share, "provenance": 0.0}
    part_of = FIRST_WORDS | {name: array.part for name, array in BY_NAME.items()}
    return sum(n * counted.get(part_of[name], 1.0) for name, n in packed.summary.bytes.items())
