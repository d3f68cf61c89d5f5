"""The packed file: every array, its dimensions, dtype, unit and meaning. docs/FORMAT.md says the same in prose.

Dimensions: n splats; c chunks of CHUNK splats; g groups of GROUP splats; b batches; k atoms; r ranks (atoms a splat,
at most); w weight levels; s words of a chunk's sizes; and of a group, as many as it has at most: e 32-bit words of a
stream, u bytes under a range coder; v arrays whose rows a group has any number of; y bytes of maps' pictures, x texels
of maps; and of a file in archive form m models that groups begin with, z bytes of atoms.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING

from storage.json_fields import listed, numbers, plain, typed, whole_numbers
from storage.limits import ATOM_SIZES as ATOM_SIZES
from storage.limits import MAX_ATOMS as MAX_ATOMS
from storage.maps import StoredMap

if TYPE_CHECKING:  # the command line knows limits of knobs from here, and answers before numpy could be imported
    import numpy as np

FORMAT_NAME = "splatpress"
FORMAT_VERSION = 1
CHUNK = 128
GROUP = 8192
PATCH_SIZE = 32
MIP_SIZES = (32, 16, 8, 4, 2, 1)
TURN_COUNTS = (1, 8)  # ways in which an atom is used: as it is, or turned and mirrored too
CLIPLINE_BITS = 12
ELLIPSOID_FIELD_BITS, ELLIPSOID_FIELDS = 8, 4  # so an ellipsoid is one whole word
NO_CAMERA = 0xFFFF
STEPS_AN_OCTAVE = 16  # of lengths in boxes of colours: code s is 2^(s / 16 - 6) of 255ths
FINEST_COLOR_STEP, COARSEST_COLOR_STEP = 80, 255  # half a 255th, and more than there are; 0 stands for whole bytes
COLOR_TURN_W = 306  # of quaternions of boxes of colours: the axes nearest to none then have bytes for x, y and z
MOST_COLOR_BITS = 30  # of a splat: what the finest step takes for a box of all colours
DEFAULT_UP, DEFAULT_AHEAD = (0, 0, 1), (1, 0, 0)
BOXES, RUNS, QUADRICS = GEOMETRIES = ("boxes", "runs", "quadrics")  # how positions and normals are coded
COLUMN_BITS, ROW_BITS, SLICE_BITS, LENGTH_BITS = 11, 11, 5, 5  # of the start of a run, the lowest first
MOST_RUNS = 256  # of a section
LEAST_NUMBER_BITS, MOST_NUMBER_BITS = 16, 47  # of the number of a splat over a quadric
MOST_FRAME_CELLS = 4096  # along an axis of a quadric's frame
NORMAL_GRIDS = 16  # of octahedral maps over quadrics: map x has 175 - 8 x steps
LEAST_SIDE = 2.0**-100  # of a group's box, as origins of frames count in it
TURN_W = 117  # of quaternions whose other entries are bytes; those of encoders are below 1.083 of it
SIZE_BITS = (0, 2, 3, 4)  # that a splat's radius may take, 4 over quadrics; without any all have the header's
SIZE_STEPS_AN_OCTAVE, ONE_SIZE = 16, 128  # of radii: step s is 2^((s - 128) / 16) of the header's
MOST_SIZES = 16  # values of a code of a size over quadrics
LONGEST_DIRECTION = 36  # so that 100 (up . normal)^2 of whole numbers stays within 32 bits


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion: x_cam = rotation @ (x_world - centre), pixel = f * xy / z + c.

    Looks along +z of its own frame, x right, y down; the centre of the first pixel is (0.5, 0.5), as in COLMAP.
    """

    name: str
    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    rotation: tuple[tuple[float, float, float], ...]  # (3, 3) world to camera
    centre: tuple[float, float, float]  # (3,) absolute, in the scan's unit

    @staticmethod
    def from_json(data: dict) -> Camera:
        """The camera of what `dataclasses.asdict` makes; KeyError or TypeError where it differs."""
        rotation = tuple(numbers(row, 3) for row in listed(data["rotation"], 3))
        return typed(Camera, data, rotation=rotation, centre=numbers(data["centre"], 3))


@dataclass(frozen=True)
class Batch:
    """Splats that one shader draws: the same atom count, all discs, all discs with a clipline, or all ellipsoids."""

    n_atoms: int
    clipline: bool = False
    ellipsoid: bool = False

    @property
    def kind(self) -> tuple:
        """What tells it from other batches: atom count, then what else its splats have, in the order of EXTRAS."""
        return (self.n_atoms, *(getattr(self, extra.flag) for extra in EXTRAS))


@dataclass(frozen=True)
class Extra:
    """What only some splats have: a field of `Batch`, and a word stream with its table that files without it lack."""

    flag: str  # the field of Batch
    stream: str
    table: str
    bits: int  # of a field
    n_fields: int = 1  # of a splat


EXTRAS = (
    Extra("clipline", "cliplines", "clipline_word", CLIPLINE_BITS),
    Extra("ellipsoid", "ellipsoids", "ellipsoid_word", ELLIPSOID_FIELD_BITS, ELLIPSOID_FIELDS),
)


@dataclass(frozen=True)
class RunGrid:
    """The hexagonal close packed grid of a file whose geometry is runs (pipeline/geometry/hcp.py), and how many runs
    there are."""

    cell: float  # distance of neighbouring centres, in `unit`
    turn: tuple[float, ...]  # (9,) rows of the matrix from the grid's axes to those of the file
    n_sections: int
    n_runs: int


CODER = 3  # of archives: models that are mixed, and told of neighbours' textures; files of any other are refused


@dataclass(frozen=True)
class Archived:
    """What a file holds of itself in fewer bytes than a GPU takes (storage/packed/archive)."""

    dictionary_bytes: int  # of all atoms' texels; 0 where the levels of atoms are arrays as in other files
    n_models: int  # that groups begin with; 0 where they know nothing
    coder: int  # CODER


@dataclass(frozen=True)
class Header:
    """What holds for the whole packed file; stored as attributes of its root group."""

    n_splats: int
    radius: float  # of every splat, in `unit`; with `size_bits` what their radii are steps of
    unit: str
    origin: tuple[float, float, float]  # absolute; boxes are against it
    up: tuple[int, int, int]  # what tangent frames are aligned with on walls, at most LONGEST_DIRECTION long
    ahead: tuple[int, int, int]  # and on floors
    margin_radii: float  # how far behind the nearest surface splats still blend, in radii of the splat that is nearest
    n_dictionary: int  # atoms in the dictionary; 0 in a scan without texture
    dictionary_bits: int
    weight_bits: int
    batches: tuple[Batch, ...]
    cameras: tuple[Camera, ...]
    scan: dict  # name, format, n_points as read
    settings: dict  # what the job asked for
    effects: dict = field(default_factory=dict)  # of those that are on: what shaders and comparisons need of them
    atom_size: int = PATCH_SIZE  # texels to a side of an atom's finest level
    n_turns: int = 1  # ways in which an atom is used, one of TURN_COUNTS
    coarsest_size: int = 1  # texels to a side of an atom's coarsest level, one of MIP_SIZES up to atom_size
    n_ranks: int = MAX_ATOMS  # rows of weight levels: no splat has more atoms
    size_bits: int = 0  # of a splat's radius, one of SIZE_BITS
    levels: tuple[int, ...] = ()  # splats of each level, the coarsest first, which stand so; none: all are of one
    maps: tuple[StoredMap, ...] = ()  # of laser stations, that splats are textured from fragment by fragment
    color_step: int = 0  # what cells of colours are no larger than, as a code; 0 where `color` has whole bytes
    geometry: str = BOXES  # one of GEOMETRIES
    runs: RunGrid | None = None  # of the geometry runs
    archive: Archived | None = None  # of a file in archive form
    shipped: str = (
        ""  # the dictionary that ships with the program whose first atoms these are; "" where the file has them
    )

    @property
    def mip_sizes(self) -> tuple[int, ...]:
        """Of the dictionary's levels, the finest first."""
        return tuple(size for size in MIP_SIZES if self.coarsest_size <= size <= self.atom_size)

    @property
    def n_indices(self) -> int:
        """Atoms that an index may name: each of the dictionary's in every turn."""
        return self.n_dictionary * self.n_turns

    @property
    def n_finest(self) -> int:
        """Splats of the finest level, which are the last."""
        return self.levels[-1] if self.levels else self.n_splats

    @property
    def first_finest(self) -> int:
        return self.n_splats - self.n_finest

    @property
    def n_chunks(self) -> int:
        return -(-self.n_splats // CHUNK)

    @property
    def n_groups(self) -> int:
        return -(-self.n_splats // GROUP)

    @property
    def entry_bits(self) -> int:
        """Bits of one atom of one code: its index, of the turn and above it the atom, then its weight."""
        return self.dictionary_bits + self.weight_bits

    def to_json(self) -> dict:
        header = {"format": FORMAT_NAME, "version": FORMAT_VERSION, **asdict(self)}
        header["batches"] = tuple({k: v for k, v in b.items() if v or k != "ellipsoid"} for b in header["batches"])
        called_for = {name: getattr(self, name) for name in ("effects", "levels", "maps", "runs", "archive", "shipped")}
        called_for["geometry"] = self.geometry != BOXES
        return {name: value for name, value in header.items() if called_for.get(name, True)}

    @staticmethod
    def from_json(data: dict) -> Header:
        """The header of attributes as `to_json` makes them; KeyError or TypeError where they differ."""
        runs = data.get("runs") or {}
        return typed(
            Header,
            {"effects": {}, "geometry": BOXES, "shipped": ""} | data,
            runs=typed(RunGrid, runs, turn=numbers(runs["turn"], 9)) if data.get("geometry") == RUNS else None,
            archive=typed(Archived, data["archive"]) if "archive" in data else None,
            levels=tuple(plain(n, "int", "a level") for n in listed(data.get("levels", ()))),
            maps=tuple(map(StoredMap.from_json, listed(data.get("maps", ())))),
            origin=numbers(data["origin"], 3),
            up=whole_numbers(data["up"], 3),
            ahead=whole_numbers(data["ahead"], 3),
            batches=tuple(typed(Batch, {"ellipsoid": False} | batch) for batch in listed(data["batches"])),
            cameras=tuple(map(Camera.from_json, listed(data["cameras"]))),
        )


@dataclass(frozen=True)
class Array:
    """One array of the packed file. `part` is the row of the size table that its bytes are counted in."""

    name: str
    dims: tuple[str, ...]
    dtype: str
    part: str  # "geometry" | "codes" | "colors" | "dictionary" | "maps" | "provenance"
    meaning: str

    @property
    def is_ragged(self) -> bool:
        """Whether groups have any number of rows of it: `group_rows` says how many of a group's count, the others are
        0."""
        return self.dims[0] == "g" and bool({"e", "u"} & set(self.dims))

    @property
    def in_groups(self) -> bool:
        """Whether a group's rows are a zarr chunk of their own."""
        return self.is_ragged or self.dims[0] in "nc"


ARRAYS = (
    Array("box_low", ("c", "3"), "float32", "geometry", "lowest corner of each chunk's box against the origin, unit"),
    Array("box_size", ("c", "3"), "float32", "geometry", "extents of each chunk's box, unit"),
    Array("box_bits", ("c", "3"), "uint8", "geometry", "how many of the 24 position bits each axis has"),
    Array("size_scale", ("c", "2"), "uint8", "geometry", "steps of each chunk's smallest and largest radius"),
    Array("sizes", ("c", "s"), "uint32", "geometry", "radius of each splat between them, a chunk in whole words"),
    Array("position", ("n", "3"), "uint8", "geometry", "24-bit cell index, little-endian: x lowest, then y, then z"),
    Array("normal", ("n", "2"), "int8", "geometry", "octahedral normal, -127..127"),
    Array("frame_origin", ("c", "3"), "uint16", "geometry", "lowest corner of each chunk's cells in its group's box"),
    Array("frame_turn", ("c", "3"), "int8", "geometry", "x, y, z of a quaternion with w 117: the chunk's axes"),
    Array("frame_step", ("c",), "uint16", "geometry", "side of each chunk's cells, unit: the upper half of a float32"),
    Array("frame_cells", ("c", "2"), "uint16", "geometry", "how many cells along the first two axes"),
    Array("frame_curve", ("c", "3"), "int8", "geometry", "how the quadric rises by half cells squared"),
    Array("frame_bits", ("c",), "uint8", "geometry", "bits of each splat's number"),
    Array("normal_low", ("c", "2"), "int16", "geometry", "octahedral coordinates that steps of normals count from"),
    Array("normal_cells", ("c", "2"), "uint8", "geometry", "steps of normals along each coordinate, less 1"),
    Array("normal_slope", ("c", "4"), "int8", "geometry", "256ths by which normals turn a half cell"),
    Array("normal_lean", ("c",), "int8", "geometry", "64ths by which the second coordinate follows the first's steps"),
    Array("normal_grid", ("c",), "uint8", "geometry", "how fine the octahedral map of each chunk is: 175 - 8 x steps"),
    Array("splats", ("g", "e"), "uint32", "geometry", "number of each splat: its normal's steps lowest, then its cell"),
    Array("run_codes", ("g", "u"), "uint8", "geometry", "sections, starts, turns and steps of normals, range coded"),
    Array("run_codebook", ("32", "2"), "int8", "geometry", "steps of normals on the octahedral map"),
    Array("run_batch", ("n",), "uint8", "geometry", "batch of each cell, in the order of the runs"),
    Array("color", ("n", "3"), "uint8", "colors", "average of the patch, sRGB"),
    Array("color_low", ("c", "3"), "int16", "colors", "lowest corner of each chunk's box of colours, 32nds of a 255th"),
    Array("color_size", ("c", "3"), "uint8", "colors", "extents of that box, in sixteenths of an octave"),
    Array("color_turn", ("c", "3"), "int8", "colors", "x, y, z of a quaternion with w 306: the axes of that box"),
    Array("colors", ("g", "e"), "uint32", "colors", "cell of each splat's average in its chunk's box"),
    Array("batch_count", ("c", "b"), "uint8", "codes", "how many splats of the chunk belong to each batch"),
    Array("codes", ("g", "e"), "uint32", "codes", "atoms and weights, a bit stream, lowest bit first"),
    Array("weight_levels", ("r", "w"), "float32", "dictionary", "the weight that a weight code stands for, by rank"),
    Array("atom_scale", ("k",), "float32", "dictionary", "what one step of an atom's texels is worth, sRGB in [0, 1]"),
    *(
        Array(f"atoms_{s}", ("k", str(s), str(s), "3"), "int8", "dictionary", f"texels of the atoms, {s}x{s} RGB")
        for s in MIP_SIZES
    ),
    Array("cliplines", ("g", "e"), "uint32", "geometry", "3 x 4 bits a splat of the batches that have cliplines"),
    Array("ellipsoids", ("g", "e"), "uint32", "geometry", "4 x 8 bits a splat of the batches that are ellipsoids"),
    Array(
        "station",
        ("n",),
        "uint8",
        "maps",
        "the map each splat is textured from, 128 more from the front alone; 255 none",
    ),
    Array("map_colors", ("y",), "uint8", "maps", "a WebP picture of each map's colours, one after the other"),
    Array("map_depth_low", ("x",), "uint8", "maps", "low bytes of what depth codes are above those a row before"),
    Array("map_depth_high", ("x",), "uint8", "maps", "high bytes of that"),
    Array("archive_models", ("m",), "uint8", "provenance", "what is known of each model; 0 where nothing is"),
    Array("archive_atoms", ("z",), "uint8", "dictionary", "texels of the atoms' finest level, range coded"),
    Array("archive", ("g", "u"), "uint8", "provenance", "all that the group has but its row of the table, range coded"),
    Array("camera", ("n",), "uint16", "provenance", "the camera each splat was textured from; 65535 none"),
    Array("group_low", ("g", "3"), "float32", "geometry", "lowest corner of what each group lies in, from the origin"),
    Array("group_high", ("g", "3"), "float32", "geometry", "its highest corner"),
    Array("group_cone", ("g", "4"), "int8", "geometry", "axis of a cone of its normals, cosine of its half angle"),
    Array("group_radius", ("g", "2"), "float32", "geometry", "mean radius of its splats by area and largest, unit"),
    Array("group_rows", ("g", "v"), "uint32", "geometry", "rows that count of each array of which it has any number"),
    Array("group_start", ("g",), "uint64", "provenance", "where its members begin in the file"),
    Array("group_bytes", ("g",), "uint64", "provenance", "bytes of its members, their headers in the zip with them"),
    Array("group_seal", ("g", "32"), "uint8", "provenance", "SHA-256 of its zarr chunks, as they stand in the file"),
)
BY_NAME = {array.name: array for array in ARRAYS}
COLOR_BOXES = ("color_low", "color_size", "color_turn")  # of chunks whose colours are in boxes
ARCHIVE = ("archive", "archive_atoms", "archive_models")
FRAMES = tuple(name for name in BY_NAME if name.startswith(("frame_", "normal_")))  # of chunks over quadrics
FORMS = (
    dict.fromkeys(("box_low", "box_size", "box_bits", "position", "normal"), BOXES)
    | {name: RUNS for name in BY_NAME if name.startswith("run_")}
    | dict.fromkeys((*FRAMES, "splats"), QUADRICS)
)  # arrays of one geometry alone


def arrays_of(header: Header) -> tuple[Array, ...]:
    """The arrays that a file with this header holds: what a scan does not call for is not there."""
    if header.archive:
        return _archived(header)
    absent = {name for name, form in FORMS.items() if form != header.geometry} | set(ARCHIVE)
    absent |= {"run_batch"} if len(header.batches) < 2 else set()
    if not header.n_dictionary:
        absent |= {a.name for a in ARRAYS if a.part == "dictionary"} | {"codes"}
    absent |= {f"atoms_{size}" for size in MIP_SIZES if size not in header.mip_sizes}
    absent |= set(atom_arrays(header)) if header.shipped else set()
    absent |= set() if header.size_bits else {"size_scale", "sizes"}
    absent |= {"sizes"} if header.geometry == QUADRICS else set()
    absent |= {"color"} if header.color_step else set(COLOR_BOXES) | {"colors"}
    for extra in EXTRAS:
        if not any(getattr(batch, extra.flag) for batch in header.batches):
            absent.add(extra.stream)
    absent |= set() if header.cameras else {"camera"}
    absent |= set() if header.maps else {array.name for array in ARRAYS if array.part == "maps"}
    if not any(array.is_ragged for array in ARRAYS if array.name not in absent):
        absent.add("group_rows")
    return tuple(array for array in ARRAYS if array.name not in absent)


def atom_arrays(header: Header) -> tuple[str, ...]:
    """The arrays of atoms, by name: what a file lacks whose atoms ship with the program."""
    return "atom_scale", *(f"atoms_{size}" for size in header.mip_sizes)


def _archived(header: Header) -> tuple[Array, ...]:
    """Of a file in archive form: the groups' arrays are in `archive`, the atoms' in `archive_atoms`."""
    assert header.archive
    plain_form = arrays_of(replace(header, archive=None))
    kept = {a.name for a in plain_form if not a.in_groups} | {"archive", "archive_models", "group_rows"}
    if header.archive.dictionary_bytes:
        kept = kept - {f"atoms_{size}" for size in MIP_SIZES} | {"archive_atoms"}
    if not header.archive.n_models:
        kept.remove("archive_models")
    return tuple(array for array in ARRAYS if array.name in kept)


def dimensions_of(header: Header) -> dict[str, int]:
    """The size of every named dimension but those that differ by group (storage/packed/groups.py)."""
    return {
        "n": header.n_splats,
        "c": header.n_chunks,
        "g": header.n_groups,
        "b": len(header.batches),
        "k": header.n_dictionary,
        "r": header.n_ranks,
        "w": 2**header.weight_bits,
        "s": CHUNK * header.size_bits // 32,
        "y": sum(m.color_bytes for m in header.maps),
        "x": sum(m.n_texels for m in header.maps),
        "v": sum(array.is_ragged for array in arrays_of(replace(header, archive=None))) + bool(header.archive),
        "z": header.archive.dictionary_bytes if header.archive else 0,
        "m": header.archive.n_models if header.archive else 0,
    } | {str(s): s for s in (1, 2, 3, 4, 8, 16, 32)}


def color_bits(size, step: int):
    """Bits of each axis, (c, 3) int64, of boxes of colours with the extents `size` (c, 3) uint8: halvings until no cell
    is larger than `step`. By whole numbers, so that readers and writers agree and no table of them is stored."""
    return (-(-(size.astype(int) - step) // STEPS_AN_OCTAVE)).clip(0)


def curve_units(cells: np.ndarray) -> np.ndarray:
    """What 1 of `frame_curve` is, (c,) float64, cells a product of half cells: 2^-7 over the power of two above the
    longer side's cells."""
    import numpy as np

    longest = cells.max(axis=1).astype(np.int64)
    return 2.0 ** -(7 + np.frexp(longest.astype(np.float64))[1])


def size_cells(scale: np.ndarray) -> np.ndarray:
    """How many values codes of sizes have over quadrics, (c,) uint8, of scales (c, 2) from their smallest to their
    largest: one ratio of at most 15 / 8 of a sixteenth of an octave between two, but MOST_SIZES at most. By whole
    numbers, so that readers and writers agree and no table of them is stored.

    With that ratio radii are as far off as in 3 bits (docs/ACCURACY.md)."""
    import numpy as np

    low, high = scale.astype(np.int64).T
    return (1 + -(-8 * (high - low) // 15)).clip(1, MOST_SIZES).astype(np.uint8)


def origin_quanta(code: np.ndarray) -> np.ndarray:
    """What encoders make origins of frames whole multiples of, (c,) float64: half the power of two below the side of
    the cells, of which `frame_step` (c,) has the upper half of the float32."""
    import numpy as np

    return np.exp2((code.astype(np.int64) >> 7) - 128.0)


def origin_units(box: np.ndarray) -> np.ndarray:
    """What `frame_origin` counts in, (c,) float64, of the boxes (c, 6) float32 of groups, low corners first: the power
    of two of which the box's longest side has 2^15 to 2^16."""
    import numpy as np

    longest = np.maximum((box[:, 3:] - box[:, :3]).max(axis=1), np.float32(LEAST_SIDE))
    return np.exp2((longest.view(np.uint32) >> np.uint32(23)).astype(np.float64) - (127 + 15))


def frame_origins(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Lowest corners (c, 3) float64 against the origin of the cells of each chunk, by its group's box."""
    import numpy as np

    box = arrays["frame_box"]
    return box[:, :3].astype(np.float64) + arrays["frame_origin"] * origin_units(box)[:, None]


def normal_steps(grid: np.ndarray) -> np.ndarray:
    """Steps (c,) int64 from the middle of a chunk's octahedral map to its edges, 55..175, of `normal_grid`. With 175
    100 (up . point)^2 of the tangent frame is below 2^32."""
    return 175 - 8 * grid.astype(int)


def steps_of(code: np.ndarray) -> np.ndarray:
    """The sides (c,) float64 of cells of which `frame_step` (c,) has the upper half of the float32."""
    import numpy as np

    return (code.astype(np.uint32) << np.uint32(16)).view(np.float32).astype(np.float64)
