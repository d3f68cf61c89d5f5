"""Every array of a work folder: who makes it, its dtype, dimensions and meaning; as `storage.packed.schema` has those
of the packed file. Tests hold every stage that they run against it (tests/conftest.py). Arrays of a stage beside the
packed file, which no other reads, stand in its own file (`pipeline.stages.beside`).

Dimensions: n points or splats; c chunks of CHUNK splats; i a task, a station or a photograph, whose number ends the
name; h, w pixels; k atoms; d coefficients of a patch; p principal components; m what the row says. Lengths are in the
scan's unit, positions against the origin of the points, but for those of the ingest, which are as read. The stage
`sampled` has rows of any other.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from storage.packed.schema import BY_NAME, FRAMES
from storage.work import arrays
from storage.work.layout import Layout

ANY = ""  # of a dtype: as its source has it


@dataclass(frozen=True)
class WorkArray:
    """A row. A name that ends in _i stands for one array a number."""

    name: str
    dtype: str
    dims: tuple[str | int, ...]
    stages: tuple[str, ...]
    meaning: str

    def fits(self, layout: Layout) -> bool:
        """Whether an array of that layout is one of these."""
        given = [dim for dim in self.dims if dim != "i"]
        sizes = zip(given, layout.shape)
        return (
            self.dtype in (ANY, layout.dtype.name)
            and len(given) == len(layout.shape)
            and all(dim == size for dim, size in sizes if isinstance(dim, int))
        )


_READ = ("ingest",)
_ORDERED = ("partition", "coarser-level", "levels", "run-points")
_COLUMNS = (*_READ, *_ORDERED)
_PATCHES = ("resample", "resample-maps", "patch-sample")
_SIZED = ("sizes", "levels", "splats")

WORK_ARRAYS = (
    # points
    WorkArray("position", "float64", ("n", 3), (*_COLUMNS, "iso-surface"),
              "where a point lies; not finite where it is dropped"),
    WorkArray("position", "float32", ("n", 3), _READ, "the same of a file that has coordinates as float32"),
    WorkArray("normal", "float32", ("n", 3), (*_COLUMNS, "iso-surface", "neighbours"),
              "unit; zeros or not finite for none"),
    WorkArray("color", "uint8", ("n", 3), (*_COLUMNS, "iso-surface", "splats"), "sRGB"),
    WorkArray("intensity", "float32", ("n",), _COLUMNS, "as the scan has it"),
    WorkArray("station", "int32", ("n",), _COLUMNS, "which scanner saw a point"),
    WorkArray("candidate", "uint16", ("n", 8), _COLUMNS, "cameras that see a point, the sharpest first; NO_CAMERA for none"),
    WorkArray("point", "int64", ("n",), (*_ORDERED, "resample", "patch-sample"),
              "the number of a point in its file; a level in the upper bits"),
    WorkArray("point", "uint32", ("n",), ("resample-maps", "patch-sample"), "the same"),
    WorkArray("block_box", "float64", ("m", 2, 3), (*_ORDERED, "sampled"), "corners of the box of each block's points"),
    WorkArray("sample", "float64", ("m", 3), (*_READ, "iso-surface"), "some positions, evenly among all"),
    WorkArray("kept", "bool", ("n",), ("thin",), "whether a point is one of the share that is asked for"),
    WorkArray("photo_i", "uint8", ("i", "h", "w", 3), (*_READ, "exposure", "photo-variant"),
              "a photograph, sRGB, in tiles"),
    WorkArray("depth_i", "float32", ("i", "h", "w"), ("depth-maps",),
              "distance along the view; infinite where there is nothing"),
    WorkArray("voxels", ANY, ("m", "h", "w"), ("voxels",), "values of a volume, m slices"),
    # leaves of large scans
    WorkArray("edges", "float64", (3, "m"), ("grid-counts",), "where cells of the grid end along each axis"),
    WorkArray("cell", "int32", ("m",), ("grid-counts",), "cells that hold points, ascending"),
    WorkArray("begin", "int64", ("m",), ("grid-counts",), "where a cell's points begin among its leaf's"),
    WorkArray("leaf", "int64", ("m",), ("grid-counts",), "the leaf of a cell"),
    WorkArray("start", "int64", ("m",), ("grid-counts",), "where each leaf's points begin, and the end"),
    WorkArray("n_before", "int64", ("m", "k"), ("grid-counts",),
              "points of divided cells before each part of the file"),
    WorkArray("run", "int64", ("m", 3), ("leaves",),
              "part, first record and count of points that lie together, leaf by leaf"),
    WorkArray("first", "int64", ("m",), ("leaves",), "where each leaf's rows of `run` begin, and the end"),
    # neighbourhoods, sizes, levels
    WorkArray("spacing", "float32", ("n",), ("neighbours", "levels", "run-points"), "distance to the fourth neighbour"),
    WorkArray("degenerate", "bool", ("n",), ("neighbours", "coarser-level", "levels", "run-points"),
              "no plane gave a normal"),
    WorkArray("size_code", "uint8", ("n",), _SIZED, "a splat's radius in steps of its chunk's scale"),
    WorkArray("size_scale", "uint8", ("c", 2), _SIZED, "smallest radius and step, in 16ths of an octave"),
    WorkArray("size_cells", "uint8", ("c",), _SIZED, "how many steps there are"),
    WorkArray("splat_normal", "float32", ("n", 3), ("coarser-level",), "of the splats that one stands for"),
    WorkArray("splat_radius", "float32", ("n",), ("coarser-level",), "that covers the splats that one stands for"),
    # splats
    WorkArray("position_code", "uint32", ("n",), ("splats",), "8 bits an axis in the box of its chunk"),
    WorkArray("number", "uint64", ("n",), ("splats",), "over the quadric of its chunk"),
    WorkArray("normal_code", "int8", ("n", 2), ("splats", "run-points"), "octahedral"),
    WorkArray("normal_point", "int16", ("n", 3), ("splats",), "over quadrics: a point of an octahedron"),
    WorkArray("camera", "uint16", ("n",), ("splats",), "that textures a splat; NO_CAMERA for none"),
    WorkArray("box_low", "float32", ("c", 3), ("splats",), "corner of a chunk's box"),
    WorkArray("box_size", "float32", ("c", 3), ("splats",), "its sides"),
    WorkArray("box_bits", "uint8", ("c", 3), ("splats",), "bits that each of its axes gets"),
    WorkArray("frame_box", "float32", ("c", 6), ("splats",), "corners of the box of a chunk's group"),
    *(WorkArray(name, BY_NAME[name].dtype, ("c", *map(int, BY_NAME[name].dims[1:])), ("splats",), "as packed")
      for name in FRAMES),
    WorkArray("centre", "float32", ("n", 3), ("splats",), "decoded, of runs"),
    WorkArray("has_ellipsoid", "bool", ("n",), ("ellipsoids", "splats"), "whether a splat is one"),
    WorkArray("ellipsoid", "uint8", ("n", 4), ("splats",), "a turn and three logarithms of radii"),
    WorkArray("centre", "float64", ("n", 3), ("ellipsoids",), "of an ellipsoid"),
    WorkArray("axes", "float32", ("n", 3, 3), ("ellipsoids",), "of an ellipsoid, as long as its radii"),
    WorkArray("has_clipline", "bool", ("n",), ("cliplines", "map-cliplines"), "whether a disc is cut"),
    WorkArray("clipline", "uint32", ("n",), ("cliplines", "map-cliplines"), "angle and offset of the cut, in 12 bits"),
    WorkArray("nearest_i", "float32", ("i", "h", "w", 3), ("nearest-points",),
              "the point nearest to an eye, by cell of its picture"),
    # runs
    WorkArray("bricks", "int64", ("m", 6), ("run-grid",), "first cell and end of each brick"),
    WorkArray("key_i", "int64", ("i", "n"), ("run-cells",), "cells that hold points, or were added"),
    WorkArray("normal_i", "float32", ("i", "n", 3), ("run-cells",), "mean of a cell's points"),
    WorkArray("point_i", "int64", ("i", "n"), ("run-cells", "runs"), "the row of a point that stands for the cell"),
    WorkArray("cell_i", "int32", ("i", "m"), ("run-cells",), "cells run by run; one may stand in two"),
    WorkArray("start_i", "int64", ("i", "m"), ("run-cells",), "where each run begins, and the end"),
    WorkArray("sample_i", "float32", ("i", "m", 3), ("run-cells",), "normals along some runs"),
    WorkArray("sample_start_i", "int64", ("i", "m"), ("run-cells",), "where each of these runs begins, and the end"),
    WorkArray("codebook", "int8", ("m", 2), ("run-cells",), "steps of normals, for all runs"),
    WorkArray("run_base_i", "int32", ("i", "m", 3), ("runs",), "corner of each section, in cells"),
    WorkArray("run_first_i", "uint32", ("i", "m"), ("runs",), "its first run"),
    WorkArray("run_start_i", "uint32", ("i", "m"), ("runs",), "where a run begins, and its length"),
    WorkArray("run_normal_i", "int8", ("i", "m", 2), ("runs",), "its first normal"),
    WorkArray("run_step_i", "uint8", ("i", "n"), ("runs",), "direction and step of the normal, cell by cell"),
    WorkArray("position_i", "float32", ("i", "n", 3), ("runs",), "decoded"),
    WorkArray("normal_code_i", "int8", ("i", "n", 2), ("runs",), "decoded"),
    # station maps
    WorkArray("color_i", "uint8", ("i", "h", "w", 4), ("panoramas", "edited-maps"),
              "what a station saw, sRGB and alpha"),
    WorkArray("depth_i", "uint16", ("i", "h", "w"), ("panoramas", "edited-maps"),
              "its distance, in steps of a logarithm"),
    WorkArray("map_colors_i", "uint8", ("i", "m"), ("map-pictures",), "a map's colours as WebP"),
    WorkArray("map_depth_low_i", "uint8", ("i", "h", "w"), ("map-pictures",), "lower bytes of its codes of depth"),
    WorkArray("map_depth_high_i", "uint8", ("i", "h", "w"), ("map-pictures",), "upper bytes"),
    WorkArray("station", "uint8", ("n",), ("mapped-splats",), "whose map textures a splat; NO_MAP for none"),
    # patches and their codes
    WorkArray("texel", "uint8", ("n", 3072), _PATCHES, "a patch of 32x32 texels, sRGB"),
    WorkArray("average", "float32", ("n", 3), (*_PATCHES, "colors", "mapped-splats"),
              "mean colour of a patch; of `colors` as the file has it"),
    WorkArray("energy", "float32", ("n",), (*_PATCHES, "colors", "mapped-splats"),
              "squared norm of what the average leaves; 0 where maps are looked up"),
    WorkArray("color_code", "uint32", ("n",), ("colors",), "in the box of its chunk's colours"),
    WorkArray("color_low", "int16", ("c", 3), ("colors",), "corner of that box"),
    WorkArray("color_size", "uint8", ("c", 3), ("colors",), "its extents, in 16ths of an octave"),
    WorkArray("color_turn", "int8", ("c", 3), ("colors",), "its axes, as a quaternion's x, y, z"),
    WorkArray("texel_i", "uint8", ("i", "n", 3072), ("training-set",), "patches that were chosen"),
    WorkArray("average_i", "float32", ("i", "n", 3), ("training-set",), "their averages"),
    WorkArray("luck_i", "float64", ("i", "n"), ("training-set",),
              "by how much their draw was below their octave's share"),
    WorkArray("basis", "float32", ("d", "p"), ("components",), "orthonormal, of principal components"),
    WorkArray("coefficient_i", ANY, ("i", "n", "m"), ("components", "coefficients"),
              "of a patch; float16 where that loses nothing that counts"),
    WorkArray("rest_i", "float32", ("i", "n"), ("components", "coefficients"), "squared norm beyond them"),
    WorkArray("held_coefficient_i", "float32", ("i", "n", "m"), ("coefficients",), "of patches not learned from"),
    WorkArray("held_rest_i", "float32", ("i", "n"), ("coefficients",), "squared norm beyond them"),
    WorkArray("dictionary", "float32", ("k", "d"), ("dictionary-seed", "ksvd-update", "quantise"), "atoms, unit rows"),
    WorkArray("turned", "float32", ("m", "d"), ("dictionary-seed", "ksvd-update", "quantise"),
              "atoms in all symmetries of the square"),
    WorkArray("before", "float32", ("k", "d"), ("ksvd-update",), "the dictionary that this iteration measured"),
    WorkArray("best", "float32", ("k", "d"), ("ksvd-update",), "the best that any iteration has measured"),
    WorkArray("atom_scale", "float32", ("k",), ("quantise",), "of an atom's bytes"),
    WorkArray("atoms_i", "int8", ("i", "k", "h", "w", 3), ("quantise",), "atoms in bytes, of i texels to a side"),
    WorkArray("weight_levels", "float32", ("r", "w"), ("quantise",), "what codes of weights stand for, by rank"),
    WorkArray("n_atoms", "uint8", ("n",), ("encode",), "atoms of a splat"),
    WorkArray("atom", "uint16", ("n", "r"), ("encode",), "their indices"),
    WorkArray("weight_code", "uint8", ("n", "r"), ("encode",), "their weights"),
    WorkArray("error", "float32", ("n",), ("encode",), "squared, of what is packed"),
)  # fmt: skip
STAGES = frozenset(stage for row in WORK_ARRAYS for stage in row.stages)


def not_of_the_table(folder: Path, rows: tuple[WorkArray, ...] = WORK_ARRAYS) -> list[str]:
    """The arrays of a stage's folder, by stage and name, that the table does not have as they are."""
    stage, found = folder.name.rpartition("-")[0], []
    for name in arrays.names(folder):
        numbered, layout = re.sub(r"_\d+$", "_i", name), arrays.layout_of(folder, name)
        known = (row for row in rows if row.name in (name, numbered) and stage in row.stages)
        if not any(row.fits(layout) for row in known):
            found.append(f"{stage}: {name} {layout.dtype}{layout.shape}")
    return found
