"""What stages tell those after them: their summaries, as `storage.work.work` keeps them.

`finalise` of a stage returns one, and its folder is read as that. A folder may stand for another stage's (samples for
points, a volume's surface for an ingest); whoever needs a part that all have reads that part: `Photographs`, `InParts`.

Lengths are in the scan's unit; PSNR has a peak of 1, None where nothing was measured.
"""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.geometry.runs.frame import GridFrame
from pipeline.maps.station_map import MapFrame
from storage.packed.schema import Camera

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Counted:
    """Of any stage that works on splats."""

    n_splats: int


@dataclass(frozen=True)
class InParts:
    """Of a training set, and of what it is turned into: its parts, each a task's."""

    n_tasks: int


@dataclass(frozen=True)
class Photographs:
    """Of any folder with photo_<i>: the ingest's, or one that stands for it."""

    cameras: tuple[Camera, ...]


@dataclass(frozen=True)
class SurfaceFound:
    """What came of one iso value of a volume."""

    iso: float
    color: tuple[int, int, int]
    n_points: int
    n_added: int  # for parts thinner than a cell
    n_off: int  # left away from the surface
    n_flat: int  # of these, where the volume tells no direction
    mean_off_cells: float | None  # of those on it


@dataclass(frozen=True)
class VolumeRead:
    """Of the voxels of a volume. `directions` are the steps from voxel to voxel along i, j and k, in its frame."""

    path: str  # the file's name
    format: str
    shape: tuple[int, int, int]
    dtype: str
    directions: tuple[Vector, ...]
    origin: Vector
    spacing: Vector
    frame: str
    unit: str
    is_labels: bool
    low: float
    high: float
    n_unknown: int  # voxels that are not finite
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class VolumeSurfaces:
    """A volume, and the surfaces that were taken from it."""

    shape: tuple[int, int, int]
    dtype: str
    spacing: Vector
    origin: Vector
    directions: tuple[Vector, ...]
    frame: str
    unit: str
    low: float
    high: float
    cell: float  # spacing of the grid
    method: str
    border: str
    is_closed: bool  # surfaces end nowhere and look outwards, so that from outside no back is seen
    surfaces: tuple[SurfaceFound, ...]


@dataclass(frozen=True)
class ScanRead:
    """Of the ingest, or of the surfaces of a volume in its place."""

    format: str
    unit: str
    n_points: int
    n_read: int  # points of the file: those that are left out among them
    n_dropped: int
    low: Vector
    high: Vector
    intensity_range: tuple[float, float] | None  # what black and white stand for
    cameras: tuple[Camera, ...]
    stations: tuple[Vector, ...]
    has_visibility: bool
    has_colors: bool  # or intensity
    warnings: tuple[str, ...]
    unused: tuple[str, ...] = ()  # properties of points that nothing is made from
    seen: str = ""  # what all points say, where it is not what the sample said
    is_albedo: bool = False  # colours have no light in them: they look like something under a lamp only
    volume: VolumeSurfaces | None = None
    grid: GridFrame | None = None  # where points stay at the centres of its cells


@dataclass(frozen=True)
class Points:
    """Of points in chunk order; the boxes of their blocks lie beside them (pipeline/splats/boxes.py)."""

    n_splats: int
    origin: Vector
    levels: tuple[int, ...] = ()  # splats of each level, the coarsest first


@dataclass(frozen=True)
class LeavesGrown:
    """Of the grid that the points of a large scan are counted in."""

    n_splats: int
    n_leaves: int


@dataclass(frozen=True)
class Spacings:
    """Of the neighbourhoods of points."""

    median_spacing: float | None  # None where no point has another near
    n_degenerate: int  # points without a normal of the scan's, or of a plane
    settled: bool = False  # normals agree with their neighbours on which side is out


@dataclass(frozen=True)
class SizesNeeded:
    """Of the sizes that splats need. Shares are of area; None where nothing told the sizes."""

    n_splats: int
    large_share: float | None = None
    area_ratio: float | None = None
    n_too_small: int = 0


@dataclass(frozen=True)
class SplatsMade:
    """Of quantised splats."""

    n_splats: int
    n_without_camera: int
    mean_position_error: float
    mean_normal_error_degrees: float
    mean_error_in_radii: float = 0.0  # of positions, each in radii of its own splat
    number_bits: float = 0.0  # a splat, of numbers of quadrics before they are sorted


@dataclass(frozen=True)
class Clipped:
    """Of cliplines."""

    n_clipped: int


@dataclass(frozen=True)
class MapsDrawn:
    """Of the maps of stations, one each; None for a station that saw nothing."""

    frames: tuple[MapFrame | None, ...]
    n_left_out: int
    height_wanted: tuple[int, ...]
    n_edited: int = 0


@dataclass(frozen=True)
class PatchesMade:
    """Of patches, from photographs or from maps."""

    energy: float  # squared norms, of all
    n_flagged: int  # projections out of what they can be sampled at
    resampling_psnr_db: float | None = None
    n_coarser: int = 0  # splats of coarser levels, which stand first
    n_blind: int = 0  # that no map shows
    n_other_station: int = 0  # that a map of another station shows best
    map_texels: float | None = None  # of maps that splats span, their geometric mean; None of photographs


@dataclass(frozen=True)
class CoarserFirst:
    """Of any patches: the splats of coarser levels, which stand first."""

    n_coarser: int = 0


@dataclass(frozen=True)
class AverageColors:
    """Of average colours; `census` counts splats by octave of what these leave."""

    n_splats: int
    color_psnr_db: float | None
    census: tuple[int, ...]


@dataclass(frozen=True)
class Training:
    """Of the training set."""

    n_tasks: int
    n_patches: int  # that were chosen
    n_splats: int  # of the scan
    n_active: int  # that their average colour does not settle
    cutoff_error: float  # what would be left, were no patch above the target's error
    settled_energy: float  # of the patches that their average settles
    beyond: dict[str, float]  # by size of atoms, the squared norm of a patch that these cannot show


@dataclass(frozen=True)
class SubspaceFound:
    """Of the training set in its principal components."""

    n_tasks: int
    n_patches: int
    n_components: int
    dtype: str
    floor_psnr_db: float | None


@dataclass(frozen=True)
class CoefficientsFound:
    """Of the training set as coefficients of what atoms of a size can show; `rest` is the squared norm beyond it."""

    n_tasks: int
    n_patches: int
    rest: float


@dataclass(frozen=True)
class Seeded:
    """Of the first dictionary."""

    n_atoms: int


@dataclass(frozen=True)
class Updated:
    """Of one iteration of k-SVD. Errors are squared, summed over the training set."""

    squared_error: float  # of the best dictionary so far
    measured_error: float  # of the one that was measured
    accepted: bool
    step: float
    n_patches: int
    n_replaced: int
    n_atoms_used: int
    quantised_error: float  # of the best, over those patches that quantising looks at
    as_coded: bool = False  # errors are with weights at levels, and the multiplier times atoms


@dataclass(frozen=True)
class Quantised:
    """Of a dictionary in bytes."""

    n_atoms: int
    atom_size: int  # texels to a side
    n_turns: int  # symmetries of the square that an index names
    squared_error: float


@dataclass(frozen=True)
class Ladder:
    """Of a sample coded at each Lagrange `multiplier`; error and atoms are those of a patch on average."""

    multiplier: tuple[float, ...]
    error: tuple[float, ...]
    n_atoms: tuple[float, ...]


@dataclass(frozen=True)
class CodesMade:
    """Of codes; `histogram` counts splats by their atoms."""

    texture_psnr_db: float | None
    visible_psnr_db: float | None
    histogram: tuple[int, ...]
    mean_atoms: float


@dataclass(frozen=True)
class Packed:
    """Of a packed file: the bytes of each array, uncompressed."""

    bytes: dict[str, int]
