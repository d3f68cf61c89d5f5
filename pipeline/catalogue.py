"""The pipeline as one declaration: every stage in the order in which a scan meets it.

Order, progress, costs, estimates and the table of docs/PIPELINE.md come out of this table; what a stage does stands in
its own file. `tests/pipeline/test_catalogue.py` holds that every stage stands here under its name, and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Task(StrEnum):
    """What a task of a stage is; the cost of a task is that of its units (splats, training patches, pixels)."""

    SLICE = "about 262,144 points of the file"
    PART = "1,048,576 points of the file, or a leaf of about as many"
    BLOCK = "a block of 16,384 splats"
    GROUP = "65,536 splats"
    RANGE = "64 MiB of the packed file"
    POINTS_OF_GROUP = "8,192 splats of a coarser level"
    VOLUME = "the volume"
    SLICES = "some slices of a volume"
    BRICK = "the cells of some slices, about 1,048,576 points"
    SAMPLE = "one of at most 16 blocks"
    PHOTO = "a photograph"
    BY_PHOTO = "the splats of a photograph"
    STATION = "the points of a station"
    TRAINING = "a training block of about 4,096 patches"
    ONCE = "all of the training set"


class Phase(StrEnum):
    """Which part of a job a stage belongs to."""

    POINTS = "points"
    EFFECTS = "effects"
    TEXTURE = "texture"
    LEARNING = "learning"  # its cost is fixed by knobs, not by the scan
    FILE = "file"
    EVALUATION = "evaluation"  # run by `evaluate`, `estimate` and `report` alone


@dataclass(frozen=True)
class StageEntry:
    """A row. `share` is of a whole job's time in percent: fountain_p11, 329,992 points, preset balanced, two
    workers."""

    name: str
    file: str  # below pipeline/
    phase: Phase
    task: Task
    makes: str
    reads: tuple[str, ...] = ()  # stages whose output it reads whole
    share: float = 1.0
    when: str = ""  # not every scan, or job, has it
    by_atoms: bool = False  # its cost grows with the number of atoms, in all their turns
    beside: bool = (
        False  # run by this row alone: its file has `asked` (`stages/beside.py`), and no other stage reads it
    )


_LEARNT_FROM = ("components", "coefficients")

CATALOGUE = (
    StageEntry(
        "ingest", "stages/points/ingest.py", Phase.POINTS, Task.SLICE,
        "points and photographs as arrays; the 8 sharpest cameras of each point", share=2,
    ),
    StageEntry(
        "voxels", "stages/volumes/voxels.py", Phase.POINTS, Task.VOLUME,
        "the voxels of a volume as an array in slices", share=1, when="a volume",
    ),
    StageEntry(
        "iso-values", "stages/volumes/iso_values.py", Phase.POINTS, Task.SLICES,
        "which iso values a volume proposes", ("voxels",), when="a volume without `--iso`; `iso`",
    ),
    StageEntry(
        "iso-surface", "stages/volumes/iso_surface.py", Phase.POINTS, Task.SLICES,
        "the points of iso-surfaces, in place of the ingest's", ("voxels",), share=4, when="a volume",
    ),
    StageEntry(
        "thin", "stages/points/thin.py", Phase.POINTS, Task.PART,
        "which points are kept, as evenly spread as they stand", ("ingest",), when="`--density` below 1",
    ),
    StageEntry(
        "grid-counts", "stages/points/grid_counts.py", Phase.POINTS, Task.PART,
        "points counted per cell of a grid; cells merged to leaves of about a million points", ("ingest",),
        when="more than 1,048,576 points",
    ),
    StageEntry(
        "leaves", "stages/points/leaves.py", Phase.POINTS, Task.PART,
        "the points of each leaf", ("ingest",), when="more than 1,048,576 points",
    ),
    StageEntry(
        "partition", "stages/points/partition.py", Phase.POINTS, Task.PART,
        "points in chunk order: median split, a leaf a task", ("ingest",), share=1,
    ),
    StageEntry(
        "neighbours", "stages/points/neighbours.py", Phase.POINTS, Task.BLOCK,
        "spacing; normals where there are none", ("partition",), share=4,
    ),
    StageEntry(
        "sizes", "stages/points/sizes.py", Phase.POINTS, Task.BLOCK,
        "the size that each splat needs, in 3 bits; decided before splats are made", ("partition", "neighbours"),
    ),
    StageEntry(
        "coarser-level", "stages/points/levels.py", Phase.POINTS, Task.POINTS_OF_GROUP,
        "a quarter of the splats, each for about four that lie together; a stage a level",
        ("partition", "neighbours", "sizes"), when="levels are on",
    ),
    StageEntry(
        "levels", "stages/points/levels.py", Phase.POINTS, Task.BLOCK,
        "points, neighbours and sizes of all levels, the coarsest first", ("coarser-level", "partition"),
        when="levels are on",
    ),
    StageEntry(
        "sampled", "stages/points/sampled.py", Phase.EVALUATION, Task.BLOCK,
        "whole chunks, spread over the scan: what a pilot is run on", ("partition",), when="`estimate`",
    ),
    StageEntry(
        "depth-maps", "stages/points/depth_maps.py", Phase.POINTS, Task.PHOTO,
        "a depth map of each camera", ("partition",), share=2, when="photographs without visibility lists",
    ),
    StageEntry(
        "splats", "stages/points/splats.py", Phase.POINTS, Task.BLOCK,
        "quantised geometry, camera, colour; once more where ellipsoids are on", ("partition", "neighbours"), share=2,
    ),
    StageEntry(
        "run-grid", "stages/runs/grid.py", Phase.POINTS, Task.ONCE,
        "size and axis of a hexagonal close packed grid, from a sample; bricks of about a million points",
        ("partition", "splats"), when="geometry runs",
    ),
    StageEntry(
        "run-cells", "stages/runs/cells.py", Phase.POINTS, Task.BRICK,
        "cells that hold points, their mean normals, runs that cover them; steps of normals for all",
        ("partition", "splats", "run-grid"), share=3, when="geometry runs",
    ),
    StageEntry(
        "runs", "stages/runs/codes.py", Phase.POINTS, Task.BRICK,
        "codes of the runs, and what they decode to", ("run-cells",), share=3, when="geometry runs",
    ),
    StageEntry(
        "run-points", "stages/runs/points.py", Phase.POINTS, Task.BLOCK,
        "decoded cells in the place of the points: sizes and splats are made of them once more", ("runs", "partition"),
        when="geometry runs",
    ),
    StageEntry(
        "nearest-points", "effects/cliplines/nearest.py", Phase.EFFECTS, Task.BY_PHOTO,
        "the nearest point in each cell of each eye", ("partition",), when="cliplines may be called for",
    ),
    StageEntry(
        "measure-effects", "effects/plan/measure_effects.py", Phase.EFFECTS, Task.SAMPLE,
        "what the scan calls for, see EFFECTS.md", share=3,
    ),
    StageEntry(
        "ellipsoids", "effects/ellipsoids/stage.py", Phase.EFFECTS, Task.BLOCK,
        "which splats are thin, with centre and axes", ("partition", "splats"), share=4, when="the plan has them on",
    ),
    StageEntry(
        "cliplines", "effects/cliplines/stage.py", Phase.EFFECTS, Task.BLOCK,
        "a line for each splat that reaches over an edge", ("splats", "nearest-points"), when="the plan has them on",
    ),
    StageEntry(
        "exposure", "effects/exposure/stage.py", Phase.EFFECTS, Task.ONCE,
        "gains that bring photographs to one light, where they are looked at", when="the plan has it on",
    ),
    StageEntry(
        "panoramas", "stages/maps/panoramas.py", Phase.TEXTURE, Task.STATION,
        "what each station saw: colour, alpha and distance, drawn from all points", ("partition", "neighbours"), share=8,
        when="station maps",
    ),
    StageEntry(
        "edited-maps", "stages/maps/edited_maps.py", Phase.TEXTURE, Task.STATION,
        "maps whose pictures somebody edited", ("panoramas",), when="`compress --maps`",
    ),
    StageEntry(
        "station-light", "stages/maps/station_light.py", Phase.TEXTURE, Task.SAMPLE,
        "a gain for each station's light", ("panoramas", "splats"), share=3, when="maps of several stations",
    ),
    StageEntry(
        "map-cliplines", "stages/maps/map_cliplines.py", Phase.TEXTURE, Task.BLOCK,
        "a line for each splat that reaches over a silhouette of its map", ("panoramas", "splats"), share=2,
        when="station maps, and the plan has cliplines on",
    ),
    StageEntry(
        "map-pictures", "stages/maps/map_pictures.py", Phase.TEXTURE, Task.STATION,
        "each map as the packed file holds it: WebP for the target's PSNR, codes of depth", ("panoramas",), share=3,
        when="station maps and `--texture map`, or auto",
    ),
    StageEntry(
        "mapped-splats", "stages/maps/mapped_splats.py", Phase.TEXTURE, Task.BLOCK,
        "which map textures each splat, and its mean colour", ("panoramas", "splats"), share=8, when="`--texture map`",
    ),
    StageEntry(
        "resample-maps", "stages/maps/resample_maps.py", Phase.TEXTURE, Task.BLOCK,
        "32x32 patches from the map that shows a splat best", ("panoramas", "splats"), share=12, when="station maps",
    ),
    StageEntry(
        "resample", "stages/texture/resample.py", Phase.TEXTURE, Task.BLOCK,
        "32x32 patches in the frame of the decoded geometry", ("splats", "ingest"), share=9, when="photographs",
    ),
    StageEntry(
        "colors", "stages/texture/colors.py", Phase.TEXTURE, Task.BLOCK,
        "average colours as the file has them: in boxes of their chunks, or in bytes", when="photographs",
    ),
    StageEntry(
        "patch-sample", "stages/texture/patch_sample.py", Phase.EVALUATION, Task.BLOCK,
        "patches chosen by hash, for Figure 9", ("resample",), when="`evaluate`",
    ),
    StageEntry(
        "training-set", "stages/texture/training.py", Phase.LEARNING, Task.TRAINING,
        "patches that an average colour does not settle, chosen by hash within octaves of contrast", when="photographs",
    ),
    StageEntry(
        "components", "stages/texture/training.py", Phase.LEARNING, Task.TRAINING,
        "the training set in its principal components", ("training-set",), when="coder `paper`",
    ),
    StageEntry(
        "coefficients", "stages/texture/training.py", Phase.LEARNING, Task.TRAINING,
        "the training set as coefficients of what atoms of a size can show", ("training-set",), when="coder `default`",
    ),
    StageEntry(
        "dictionary-seed", "stages/texture/dictionary.py", Phase.LEARNING, Task.ONCE,
        "the first dictionary", _LEARNT_FROM, when="photographs", by_atoms=True,
    ),
    StageEntry(
        "ksvd-update", "stages/texture/dictionary.py", Phase.LEARNING, Task.TRAINING,
        "the dictionary after an iteration; a stage an iteration", _LEARNT_FROM, share=12, when="photographs",
        by_atoms=True,
    ),
    StageEntry(
        "quantise", "stages/texture/quantise.py", Phase.LEARNING, Task.TRAINING,
        "atoms in bytes with mip levels, weight levels; once more for the weights at the multiplier", _LEARNT_FROM, share=2, when="photographs", by_atoms=True,
    ),
    StageEntry(
        "multipliers", "stages/texture/multipliers.py", Phase.LEARNING, Task.TRAINING,
        "error and atoms of a sample at eight Lagrange multipliers; once more with these weight levels", _LEARNT_FROM, when="photographs", by_atoms=True,
    ),
    StageEntry(
        "encode", "stages/texture/encode.py", Phase.TEXTURE, Task.BLOCK,
        "codes, and what they lose", ("resample",), share=14, when="photographs", by_atoms=True,
    ),
    StageEntry(
        "photo-pages", "stages/pages/photo_pages.py", Phase.FILE, Task.PHOTO,
        "photographs as a page file: all mip levels, cut into pages", ("ingest",), beside=True,
        when="`pages`, `--pages`, or the plan has them on",
    ),
    StageEntry(
        "map-pages", "stages/pages/map_pages.py", Phase.FILE, Task.STATION,
        "maps of stations as a page file", ("panoramas",), when="station maps and `--pages`", beside=True,
    ),
    StageEntry(
        "kinds", "stages/packed/kinds.py", Phase.FILE, Task.PART,
        "which batches its splats fall into", ("splats", "encode"), when="more than 1,048,576 points",
    ),
    StageEntry(
        "pack", "stages/packed/pack.py", Phase.FILE, Task.GROUP, "the packed file", ("splats", "encode"),
    ),
    StageEntry(
        "join", "stages/packed/join.py", Phase.FILE, Task.RANGE, "the packed file as one, sealed", ("pack",),
        when="a file of more than 4 GiB",
    ),
    StageEntry(
        "measure", "stages/packed/measure.py", Phase.EVALUATION, Task.BLOCK,
        "a packed file decoded, and compared with its photographs", ("ingest",), when="`report`",
    ),
    StageEntry(
        "photo-variant", "stages/texture/photo_variants.py", Phase.EVALUATION, Task.PHOTO,
        "photographs as BC7, BC1, JPEG, WebP and AVIF leave them", ("ingest",), when="`evaluate`",
    ),
    StageEntry(
        "variant-errors", "stages/texture/photo_variants.py", Phase.EVALUATION, Task.BLOCK,
        "what that costs the patches", ("resample", "photo-variant"), when="`evaluate`",
    ),
)  # fmt: skip
BY_NAME = {entry.name: entry for entry in CATALOGUE}
LEARNING = tuple(entry.name for entry in CATALOGUE if entry.phase == Phase.LEARNING)

RENDER, PICTURES = "render", "pictures"  # what is heard as a stage, and drawn by a render worker
SHARES = {entry.name: entry.share for entry in CATALOGUE} | {RENDER: 30.0, PICTURES: 2.0}
ALWAYS = frozenset(entry.name for entry in CATALOGUE if not entry.when) | {RENDER}  # in every job that draws


def common_share(textured: bool) -> float:
    """The summed shares of what every job has, with photographs or without."""
    return sum(
        SHARES[name]
        for name in SHARES
        if name in ALWAYS or (textured and name in BY_NAME and BY_NAME[name].when == "photographs")
    )
