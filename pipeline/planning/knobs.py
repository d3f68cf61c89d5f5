"""The table of knobs: all that trades accuracy for time or bytes, what each allows, what it buys and what it costs.

Command line, `/v1/options`, validation and docs/KNOBS.md are made from it. A knob more is a field of
`pipeline.planning.settings.Settings`, which has its default, and a row here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from pipeline.readers.attributes.marks import WORDS as MARK_WORDS
from pipeline.readers.attributes.marks import canonical_marks
from pipeline.readers.attributes.options import STATION_WORDS, canonical_station
from storage.limits import ATOM_SIZES, MAX_ATOMS, MOST_LEVELS

PURSUITS = ("omp", "ormp", "1x4", "2x2", "4x2", "4x4", "8x2", "8x4")  # words of pipeline.coding.beam.form


@dataclass(frozen=True)
class Knob:
    """A row. Allowed are `choices`, or numbers from `low` to `high`, and None where it is `optional`."""

    name: str
    kind: type  # int, float or str
    help: str
    buys: str
    costs: str
    stage: str  # the first stage that a change does again; all before it are reused
    choices: tuple = ()  # of `kind`, and words
    low: float = -math.inf
    high: float = math.inf
    optional: bool = False  # None, the default, lets the scan decide
    above_low: bool = False  # `low` itself is not allowed
    ladder: tuple = ()  # what `splatpress tradeoff` tries of it, unless told otherwise, the most telling first
    canonical: Callable[[str], str] | None = None  # of a list in one text: the one text for what it asks, or ValueError
    words: str = ""  # what such a list allows
    metavar: str = "NAME=CHOICE"  # of a part of it, on a command line
    usual: float | None = None  # of a picture: what nobody asked for, where that is neither a first choice nor the most

    @property
    def allowed(self) -> str:
        """In words."""
        if self.canonical:
            return self.words
        if self.choices:
            return ", ".join(str(c) for c in self.choices)
        if self.high == math.inf:
            return f"{'above' if self.above_low else 'at least'} {_number(self.low)}"
        if self.above_low:
            return f"above {_number(self.low)}, up to {_number(self.high)}"
        return f"{_number(self.low)} to {_number(self.high)}"

    @property
    def kinds(self) -> tuple[type, ...]:
        """The types of its values, None apart."""
        return tuple(dict.fromkeys([self.kind, *map(type, self.choices)]))

    @property
    def domain(self) -> dict:
        """As JSON Schema has it."""
        if self.canonical:
            return {"description": self.words}
        if self.choices:
            return {"enum": list(self.choices)}
        low = {"exclusiveMinimum" if self.above_low else "minimum": self.low}
        return low if self.high == math.inf else low | {"maximum": self.high}

    def parsed(self, text: str):
        """The value that a text stands for. Raises ValueError saying what is allowed."""
        if text in self.choices:
            return text
        if self.canonical:
            return self.canonical(text)
        try:
            return self.checked(self.kind(text))
        except (ValueError, OverflowError):
            raise ValueError(self._refusal(text)) from None

    def checked(self, value):
        """The value as its kind. Raises ValueError saying what was found and what is allowed."""
        if value is None and self.optional:
            return None
        if self.canonical and type(value) is str:
            return self.canonical(value)
        if self.kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if self.canonical:
            ok = False
        elif self.choices:
            ok = any(type(value) is type(c) and value == c for c in self.choices)
        else:
            ok = type(value) is self.kind and math.isfinite(value) and self.low <= value <= self.high
            ok = ok and not (self.above_low and value == self.low)
        if not ok:
            raise ValueError(self._refusal(value))
        return value

    def _refusal(self, found) -> str:
        whole = "whole numbers, " if self.kind is int and not self.choices else ""
        return f"{self.name} is {found}; allowed: {whole}{self.allowed}"


def _number(value: float) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:,g}"


def _canonical_request(text: str) -> str:
    from pipeline.effects.plan.request import canonical_request  # finds all effects, which `inspect` can do without

    return canonical_request(text)


def _canonical_isos(text: str) -> str:
    from pipeline.volumes.request import canonical_isos

    return canonical_isos(text)


def _canonical_spacing(text: str) -> str:
    from pipeline.volumes.request import canonical_spacing

    return canonical_spacing(text)


KNOBS = (
    Knob(
        "coder",
        str,
        "how patches become codes: `paper` as published, with one cut-off, 32x32 atoms as they are and even weight levels",
        "default: 2 to 3 dB at the bytes of `paper`, see docs/ACCURACY.md",
        "nothing but a format newer than version 2",
        "training-set",
        choices=("default", "paper"),
    ),
    Knob(
        "atom_size",
        int,
        "texels to a side of an atom, with the default coder; auto: the fewest that show the target with 6 dB to spare, no more than 2 bytes a splat pay for",
        "detail, where a splat covers as many photo pixels",
        "four times the dictionary's bytes, and the time of learning",
        "coefficients",
        choices=("auto", *ATOM_SIZES[::-1]),
    ),
    Knob(
        "dictionary",
        str,
        "where atoms come from: own, learned from the scan; shipped, 512 of 16x16 texels that come with the program, whose bytes are "
        "in no file; auto: shipped for photographs of up to 50,000 splats, where an own one costs more than it gains",
        "shipped: fountain_p11 at equal bytes of the file 0.6 to 1.1 dB with 2,000 to 50,000 splats, monstree 0.7; no time of learning",
        "shipped: readers must have it; 0.5 MB on the GPU, whatever the scan's size; indices of 12 bits; coding takes 3 to 4 times as long, which learning outweighs below some 50,000 splats; frames of fountain_p11 of 5,000, a third more atoms, 1.13 times",
        "measure-effects",
        choices=("auto", "own", "shipped"),
    ),
    Knob(
        "dictionary_bits",
        int,
        "bits of an atom's number: 256, 4,096 or 65,536 atoms, with the default coder an eighth of that in "
        "8 turns; auto: as many atoms as half a byte a splat and a 15th of the bytes of codes pay for",
        "atoms that fit a splat better: fewer of them for the same error",
        "time of learning and coding; 4,092 bytes an atom, whatever the scan's size; bits in every code; "
        "texture fetches that miss the GPU's caches",
        "dictionary-seed",
        choices=("auto", 8, 9, 10, 11, 12, 13, 14, 16),
        ladder=(8, 10, 12),
    ),
    Knob(
        "weight_bits",
        int,
        "bits of a weight",
        "weights nearer to the best ones",
        "4 bits more an atom of a splat",
        "quantise",
        choices=(4, 5, 6, 8),
        ladder=(4, 6, 8),
    ),
    Knob(
        "max_atoms",
        int,
        "atoms that a splat may take",
        "error of the splats with the most detail",
        "bytes and frame time of those splats; time of coding",
        "ksvd-update",
        low=0,
        high=MAX_ATOMS,
        ladder=(4, 2, 6, 1),
    ),
    Knob(
        "target_psnr_db",
        float,
        "where a splat is good enough and takes no further atom",
        "error of every splat that has not yet all its atoms",
        "atoms: bytes, frame time, time of coding",
        "training-set",
        low=10.0,
        high=80.0,
        ladder=(42.0, 38.0, 44.0, 36.0, 34.0),
    ),
    Knob(
        "budget_bytes",
        float,
        "bytes a splat, of all that a GPU holds, in place of the target's error: an atom costs what makes the "
        "packed file keep it, and use 98 % or more of it",
        "a file of known size, its atoms where they mend most; the target is what the dictionary is learned for",
        "all patches are coded once more for each Lagrange multiplier that is tried, two or three times in all",
        "encode",
        low=0.0,
        optional=True,
        above_low=True,
    ),
    Knob(
        "atom_search",
        str,
        "how a splat's next atom is found, of 128 or more of whole patches: by products with all of them; by short products, "
        "certified by whole ones with the few atoms that may be the best; or by short ones alone. Atoms in turns are found by products with all of them",
        "certified: the atoms of exact search, in a third of its time (256 atoms of 32x32 texels), a sixth (4,096); approximate: a tenth less",
        "exact: that time; approximate: now and then an atom that is nearly the best, 0.01 dB there",
        "encode",
        choices=("exact", "certified", "approximate"),
    ),
    Knob(
        "pursuit",
        str,
        "which atom is a splat's next, with the default coder: omp, that of largest correlation with what is left; ormp, the one "
        "that leaves least once all weights are fitted again; WxC, a beam: W supports at a time, each tried with C atoms, and those "
        "kept that leave least with their weights as stored",
        "bytes of codes at equal error, fountain_p11 at `balanced` and monstree: 2x2 9 and 15 % fewer, 4x2 13 and 22 %, 4x4 13 and "
        "22 %, 8x4 16 % (fountain_p11); at equal bytes 0.3, 0.4 and 0.4 dB and 0.35, 0.5 and 0.5; ormp alone loses, as it does not "
        "see what rounding left",
        "time of coding: 0.3 us a splat, support followed and 1,024 indices of atoms, and 0.2 us a support and atom tried: 2x2 1.3 "
        "times omp's, 4x2 1.8 times, 4x4 twice, 8x4 2.9 times; monstree, with twice the atoms a splat, 2.1, 3.1 and 3.6 times; "
        "the last passes of learning are with 2x2 at most",
        "multipliers",
        choices=PURSUITS,
        ladder=("omp", "2x2", "4x4", "8x4"),
    ),
    Knob(
        "iterations",
        int,
        "passes of k-SVD; with the default coder the last six, of fewer than 12 the second half, look at all patches as they will be "
        "coded, with a beam of 2x2 at most and weights as stored, those before them at 10,000 with exact weights",
        "a dictionary nearer to its best; each pass gives less than the one before",
        "time of learning, in proportion",
        "ksvd-update",
        low=1,
        high=1000,
        ladder=(3, 1, 12),
    ),
    Knob(
        "least_gain_db",
        float,
        "dB that a pass of k-SVD must gain, else it is the last",
        "time: learning ends where passes gain little",
        "what later passes would have gained",
        "ksvd-update",
        low=0.0,
        high=10.0,
    ),
    Knob(
        "training_splats",
        int,
        "splats that the dictionary is learned from, beside 4,096 or a third as many that tell what it leaves of others",
        "a dictionary that fits what is rare in the scan too: 40,000 for 20,000 of fountain_p11 1.9 % fewer bytes of codes, 80,000 3.3 %",
        "time of learning, in proportion",
        "training-set",
        low=256,
        high=100_000_000,
        ladder=(10_000, 80_000, 40_000),
    ),
    Knob(
        "subspace_floor_db",
        float,
        "above the target that the components keep which the dictionary is learned in",
        "atoms nearer to those learned from whole patches",
        "time and memory of learning",
        "components",
        low=3.0,
        high=60.0,
    ),
    Knob(
        "density",
        float,
        "the share of the points that become splats, spread as evenly as the points themselves",
        "bytes, frame time and time of all stages, in proportion",
        "detail: splats are larger, their radius follows from the wider "
        "spacing, and each shows more photo pixels in as many texels and atoms",
        "thin",
        low=0.0,
        high=1.0,
        above_low=True,
    ),
    Knob(
        "radius",
        float,
        "of every splat, in the scan's unit; by default each has its own where spacing differs (effect `sizes`), else all the median distance to the 4th neighbour",
        "larger: no holes where points are sparse; smaller: sharper textures",
        "larger: overdraw, and more photo pixels a texel",
        "splats",
        low=0.0,
        optional=True,
        above_low=True,
    ),
    Knob(
        "levels",
        int,
        "coarser levels of the splats, at most; by default 3 where the scan has more splats than a picture has pixels (effect `levels`), else none",
        "far views as fast as near ones, each level a quarter of the splats",
        "a third more bytes and time at most",
        "coarser-level",
        low=0,
        high=MOST_LEVELS,
        optional=True,
    ),
    Knob(
        "view_distance",
        float,
        "of the farthest viewer, in the scan's unit; by default as far as the photographs were taken from",
        "textures that do not glitter from farther away",
        "coarser mip levels: less than a hundredth of a dictionary's bytes",
        "pack",
        low=0.0,
        optional=True,
        above_low=True,
    ),
    Knob(
        "iso",
        str,
        "of a volume: the values at which its surfaces lie, each perhaps with a colour; by default the one that its voxels "
        "pass most steeply, which `splatpress iso` prints with others",
        "more values: more surfaces",
        "points, bytes and time, in proportion to the surfaces' area",
        "iso-surface",
        canonical=_canonical_isos,
        words="VALUE or VALUE=#RRGGBB, joined by commas",
        metavar="VALUE[=#RRGGBB]",
    ),
    Knob(
        "geometry",
        str,
        "how positions and normals are coded: in boxes of 128; over a quadric that is fitted to each 128; as runs of cells in a hexagonal close "
        "packed grid; auto: boxes, or what takes fewer bytes at the error that is asked for, with `cell` runs, with `geometry_error` quadrics",
        "quadrics: 25 to 28 bits a splat for 42, and 2.5 for 3.1 where splats have sizes; runs: 9.5 to 15, and 1.6 points a splat",
        "quadrics: positions 1/30 of a radius off on average for 1/50 to 1/70, normals .32 degrees for .26 to .32; runs: positions at most cell / sqrt(2) off, "
        "normals by 2 to 4 degrees; no ellipsoids and no levels",
        "run-grid",
        choices=("auto", "boxes", "quadrics", "runs"),
    ),
    Knob(
        "geometry_error",
        float,
        "how far positions over quadrics are off on average, in radii of their splats; by default 1/30, and with a geometry of auto boxes",
        "larger: 1 bit a splat fewer for each factor of 1.26, 3 for 2",
        "larger: positions and outlines less exact",
        "splats",
        low=0.001,
        high=0.5,
        optional=True,
    ),
    Knob(
        "normal_error",
        float,
        "how far normals over quadrics are off on average, in degrees; by default 0.32, what boxes have where normals look all round",
        "larger: 2 bits a splat fewer for each factor of 2, on the GPU and on disk",
        "larger: textures lie more askew; what a lamp shows is rougher",
        "splats",
        low=0.2,
        high=0.8,
        optional=True,
    ),
    Knob(
        "archive",
        str,
        "whether the packed file is in archive form: each group of it under a range coder, decoded as it is read to just what "
        "a plain file holds; not of runs, which are coded already",
        "on: 20 to 28 % fewer bytes on disk, and on the way",
        "on: a file is read in 70 to 90 ms of a core for 8,192 splats, by all cores, a plain one in 4; browsers are given the plain form, as `export --to plain` makes it",
        "pack",
        choices=("off", "on"),
    ),
    Knob(
        "run_length",
        int,
        "of runs, in cells, at most",
        "longer: fewer starts, of 31 to 41 bits each",
        "longer: fewer runs to decode side by side, and wider cones of normals",
        "run-grid",
        low=2,
        high=32,
    ),
    Knob(
        "cell",
        float,
        "distance of neighbouring cells, in the unit of the scan or volume; by default 1.6 points of a scan lie in one on average, and one of a "
        "volume has the volume of a voxel, of the finest spacing cubed",
        "smaller: splats closer to each other and smaller; of runs errors of at most cell / sqrt(2)",
        "points of a volume as 1 / cell^2, and time as 1 / cell^3; of a scan shorter runs",
        "iso-surface",
        low=0.0,
        optional=True,
        above_low=True,
    ),
    Knob(
        "resampling",
        str,
        "how values between voxels are found: trilinear, or by a radial kernel of three lobes held between the 8 voxels about a point",
        "radial: an eighth of the error on signals that the voxels can hold",
        "radial: eight times the time of the stage iso-surface",
        "iso-surface",
        choices=("trilinear", "radial"),
    ),
    Knob(
        "border",
        str,
        "surfaces that reach the end of a volume: open there, or closed as if its lowest value lay around",
        "closed: an outside without holes",
        "closed: faces that nothing in the volume shows",
        "iso-surface",
        choices=("open", "closed"),
    ),
    Knob(
        "spacing",
        str,
        "of a volume's voxels along its three axes, the fastest in the file first, in place of what the file says",
        "shapes that are right where a file says no spacing, or a wrong one",
        "nothing",
        "voxels",
        canonical=_canonical_spacing,
        words="I,J,K, three lengths above 0",
        metavar="I,J,K",
    ),
    Knob(
        "component",
        int,
        "which number of a voxel is taken where a volume has several",
        "a volume of vectors or colours, which is refused without",
        "nothing",
        "voxels",
        low=0,
        high=2**31 - 1,
        optional=True,
    ),
    Knob(
        "time",
        int,
        "which time of a volume of several is taken",
        "a volume of several times, which is refused without",
        "nothing",
        "voxels",
        low=0,
        high=2**31 - 1,
        optional=True,
    ),
    Knob(
        "texture",
        str,
        "where colours come from: one a splat; atoms, of photographs, or of maps of what a laser scan's stations saw; these "
        "maps themselves, looked up by each fragment; auto: atoms of photographs, or, where a splat stands for 4 points of a "
        "scan with stations, atoms or maps, whichever are fewer bytes at the target's PSNR",
        "atoms: with --density 0.1 a laser scan looks as with all its points; map: sharp with a hundredth too, and trimmed at "
        "silhouettes",
        "atoms: bytes and time of coding; map: the same bytes at any density, 48 x height^2 on the GPU, and 8 lookups a "
        "fragment; maps are drawn from all points, whatever the density",
        "panoramas",
        choices=("auto", "color", "atoms", "map"),
    ),
    Knob(
        "seed",
        int,
        "of all random choices",
        "nothing: another result of the same quality",
        "nothing",
        "training-set",
        low=0,
        high=2**63 - 1,
    ),
    Knob(
        "marked_points",
        str,
        "what to do with points that the scan marks as not measured or not wanted, as withheld=keep",
        "keep: points that somebody marked and that you want to see; leave-out: a scan without them",
        "keep: what was not measured is drawn",
        "ingest",
        canonical=canonical_marks,
        words=MARK_WORDS,
    ),
    Knob(
        "station",
        str,
        "where the scanner stood that saw all points, where the scan does not say, or scanners by a LAS file's point source ids; normals that it does not bring look there",
        "surfaces that face the right way, and maps of what stations saw, in scans that were merged",
        "nothing",
        "ingest",
        canonical=canonical_station,
        words=STATION_WORDS,
        metavar="X,Y,Z",
    ),
    Knob(
        "sparse_model",
        str,
        "the folder of the COLMAP model to use, as sparse/1; by default the one that fits fused.ply best",
        "the model that you mean, where several fit",
        "nothing",
        "ingest",
        canonical=str.strip,
        words="a folder of the workspace",
        metavar="FOLDER",
    ),
    Knob(
        "height_scale",
        float,
        "what heights are multiplied by, where they are in another unit than the other coordinates, as 0.3048 for feet in metres",
        "shapes that are right in such scans",
        "nothing",
        "ingest",
        low=0.0,
        high=1e6,
        above_low=True,
    ),
    Knob(
        "page_codec",
        str,
        "how each page of photographs is coded, where they are kept in pages beside the packed file (effect `pages`, `--pages`)",
        "png: nothing lost; bc7: what a GPU samples as it is, 47 dB; jpeg: 42 dB at quality 90, read fastest; webp: 40 dB in two thirds of "
        "jpeg's bytes",
        "fountain_p11: png 36 MB, bc7 26, jpeg 7.5, webp 4.6; pages read a second and core: 930, 1,370, 5,700, 1,950",
        "photo-pages",
        choices=("jpeg", "webp", "png", "bc7"),
    ),
    Knob(
        "page_quality",
        int,
        "of pages as JPEG or WebP",
        "fountain_p11 as jpeg at 50, 75, 90, 95: 36.5, 38.8, 42.1, 44.0 dB; as webp at 75, 90: 36.5, 40.4",
        "bytes of the page file: 2.9, 4.4, 7.5, 10.8 MB; 2.2, 4.6",
        "photo-pages",
        low=1,
        high=100,
    ),
    Knob(
        "effects",
        str,
        "what effects are asked to be: name=auto, on or off, as cliplines=off; all=off for none",
        "on: an effect that the scan alone would not call for; off: its time, its bytes and its shader code",
        "on: those; off: what the effect is for; `splatpress effects` says how much",
        "measure-effects",
        canonical=_canonical_request,
        words="NAME=auto|on|off, joined by commas",
    ),
)
BY_NAME = {knob.name: knob for knob in KNOBS}

# Of a picture, not of a file: arguments of `splatpress render`.
VIEW_KNOBS = (
    Knob(
        "atoms",
        int,
        "atoms of each splat that are drawn, those of the largest weights",
        "frame time, which grows with atoms",
        "what the others would mend: within 0.2 dB of the best choice of as many of its atoms",
        "render",
        low=0,
        high=MAX_ATOMS,
    ),
    Knob(
        "precision",
        str,
        "bits a channel of the sums that splats are blended in; auto: 16, and 32 for a scene that once had more than a "
        "weight of 16 on a pixel",
        "32: sums within 1/255 however many splats lie on each other",
        "32: twice the memory and bandwidth of blending; "
        "16: up to 24/255 off where a thousand splats lie on each other",
        "render",
        choices=("auto", "16", "32"),
    ),
    Knob(
        "antialias",
        int,
        "as how many times as large to a side a picture is drawn, of which each pixel is then the mean; 2 unless asked",
        "2: soft silhouettes; far scans come 4.7 to 7 dB nearer to their own picture drawn six times as large, with 4 11 to 15 dB",
        "memory; frame time, of fountain_p11 at 1,024 px by llvmpipe 1.9 times with 2, 4.7 times with 4",
        "render",
        low=1,
        high=8,
        usual=2,
    ),
    Knob(
        "detail",
        float,
        "of a file with levels: pixels of a splat's radius about which a coarser level takes the place of the next finer one, 1 unless asked; 0 draws the finest level alone",
        "small: pictures of the finest level; large: fewer splats, and frame time goes with them",
        "large: blur, and silhouettes wider by as much",
        "render",
        low=0.0,
        usual=1.0,
    ),
    Knob(
        "most_splats",
        int,
        "of a file with levels: a budget of splats in view; where more would be drawn, detail is made larger until they are not",
        "frame time bounded at any distance",
        "blur where the budget is short",
        "render",
        low=1,
        optional=True,
    ),
    Knob(
        "pool_mib",
        float,
        "of a file with levels: MiB of splats that are in memory at a time; without it all of the file",
        "files larger than memory; what the view does not ask for is not read",
        "groups are read as views ask for them; coarser levels where the pool is too small for a view",
        "render",
        low=0.0,
        optional=True,
        above_low=True,
    ),
)
