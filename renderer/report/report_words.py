"""Figures in words: how the report writes numbers, and what each figure means."""

from __future__ import annotations

import json
from collections.abc import Callable

from pipeline.numerics.accuracy import BEST_DB

NOT_MEASURED = "–"

PARTS = {
    "geometry": "Positions (24 bits), normals (16 bits) and the boxes of the chunks they are relative to.",
    "codes": "Which atoms each splat adds up, with what weights, and how many splats have how many.",
    "colors": "The average colour of every splat: 24-bit sRGB, or a cell of its chunk's box of colours.",
    "dictionary": "The atoms with their mip levels, and what the weight codes stand for.",
    "maps": "What each station saw, as textures, and which station each splat takes its colours from.",
}

GEOMETRY_OF = {  # in the place of that of boxes
    "runs": "Where runs of cells begin, the steps from each cell to the next, and how normals change along them.",
    "quadrics": "One number a splat, of its normal and its place over a quadric, and the frames of the chunks that these are in.",
}


OF_RUNS = {  # what figures of GEOMETRY mean there
    "mean_position_error": "How far points lie from the centres of their cells, on average.",
    "mean_position_error_in_radii": "The same, against the scan's one radius.",
    "mean_normal_error_degrees": "How far normals of runs are off, on average.",
}
OF_ELLIPSOIDS = {
    "mean_position_error": "How far a splat is drawn from its point, on average: by quantisation, and where it is an ellipsoid by its "
    "centre, which lies in the middle of its neighbours.",
}


def geometry_figures(report: dict) -> list[tuple[str, str, str | None, str]]:
    """GEOMETRY in the words of the geometry that a report is of."""
    ellipsoids = any(row["effect"] == "ellipsoids" and row["enabled"] for row in report["effects"])
    words = OF_RUNS if report["runs"] else OF_ELLIPSOIDS if ellipsoids else {}
    return [(key, title, unit, words.get(key, meaning)) for key, title, unit, meaning in GEOMETRY]


def parts_of(geometry: str, sizes: dict) -> dict[str, str]:
    """What each part of the bytes on the GPU is; maps where there are any."""
    parts = PARTS | ({"geometry": GEOMETRY_OF[geometry]} if geometry in GEOMETRY_OF else {})
    return {name: meaning for name, meaning in parts.items() if name != "maps" or sizes["maps_bytes"]}


QUALITY = (  # key, title, meaning
    (
        "texture_psnr_db",
        "Texture PSNR",
        "All texels of all splats, as the file decodes them, against the textures sampled from the photographs. At 40 dB "
        "the error is 1 % of full brightness (root mean square).",
    ),
    (
        "visible_psnr_db",
        "Visible PSNR",
        "The same error, weighted as splats are blended: most at a splat's centre, nothing beyond its rim.",
    ),
    (
        "resampling_psnr_db",
        "Resampling PSNR",
        "What is lost before any compression, when pixels of photographs become square textures: photo lookups at random "
        "points of the splats against lookups in their textures. The paper has 52.63 dB.",
    ),
)

OF_STATIONS = {  # what the texture PSNR of a scan with stations means, by whether maps are in the file
    False: "All texels of all splats, as the file decodes them, against the textures sampled from what the stations saw.",
    True: "What the file keeps of what the stations saw, as it decodes it, against that itself.",
}

GEOMETRY = (  # key, title, unit, meaning; the unit of None is the scan's own
    ("mean_position_error", "Position error", None, "How far quantisation moves a splat, on average."),
    ("mean_position_error_in_radii", "… in splat radii", "radii", "The same, each against the radius of its splat."),
    ("mean_normal_error_degrees", "Normal error", "degrees", "How far quantisation tilts a splat, on average."),
)

PASSES = {
    "cull": "Finds the groups of splats that the camera can see.",
    "visibility": "Draws depth, pushed back by a margin.",
    "attribute": "Adds up the weighted colours of all splats within the margin.",
    "resolve": "Divides colours by weights.",
}


# Of DuoDecim (2006), Table 1: points of a scan or None, hit rate, efficiency, bits a point on the graphics card and on
# disk.
TABLE_1 = (
    ("Atlas", 1.60, 0.72, 8 * 231e6 / 158_877_859, 8 * 172e6 / 158_877_859),
    ("St. Matthew", 1.53, 0.74, 8 * 182e6 / 121_718_168, 8 * 140e6 / 121_718_168),
    ("David", 1.64, 0.72, 8 * 28.5e6 / 17_190_274, 8 * 21e6 / 17_190_274),
    ("Wholebody", None, 0.89, None, None),
    ("Fluid", None, 0.81, None, None),
)


def decibels(value: float | None) -> str:
    """A PSNR in words; "identical" from BEST_DB on."""
    if value is None:
        return NOT_MEASURED
    return "identical" if value >= BEST_DB else f"{value:.2f} dB"


def similarity(value: float | None) -> str:
    """An SSIM or a FLIP in words, to four places."""
    return NOT_MEASURED if value is None else f"{value:.4f}"


def factor(value: float | None) -> str:
    """A compression factor in words."""
    return NOT_MEASURED if value is None else f"{value:.1f} ×"


def percent(value: float | None) -> str:
    """A share from 0 to 1 in percent."""
    return NOT_MEASURED if value is None else f"{100 * value:.1f} %"


def number(value: float | None) -> str:
    """
    >>> number(329992), number(13749.6), number(0.00001234), number(None)
    ('329,992', '13,750', '1.234e-05', '–')
    """
    if value is None:
        return NOT_MEASURED
    return f"{value:,.0f}" if isinstance(value, int) or abs(value) >= 1000 else f"{value:.4g}"


def size(n_bytes: float | None) -> str:
    """Decimal units, as the paper has them.

    >>> size(4_718_592), size(999), size(None)
    ('4.72 MB', '999 B', '–')
    """
    if n_bytes is None:
        return NOT_MEASURED
    if n_bytes < 999.5:
        return f"{n_bytes:.0f} B"
    n_thousands = 1
    while n_thousands < 4 and n_bytes / 1000**n_thousands >= 999.5:
        n_thousands += 1
    return f"{n_bytes / 1000**n_thousands:.3g} {('kB', 'MB', 'GB', 'TB')[n_thousands - 1]}"


def duration(seconds: float | None) -> str:
    """
    >>> duration(0.00014), duration(0.0123), duration(4.2), duration(75), duration(7380)
    ('0.14 ms', '12 ms', '4.2 s', '1 min 15 s', '2 h 3 min')
    """
    if seconds is None:
        return NOT_MEASURED
    if seconds < 1:
        return f"{1000 * seconds:.0f} ms" if seconds >= 0.00995 else f"{1000 * seconds:.2g} ms"
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


ESTIMATE = (  # key, title, in words
    ("seconds", "Time", duration),
    ("peak_memory_bytes", "Peak memory of a worker", size),
    ("file_bytes", "Bytes of the file", size),
    ("gpu_bytes", "Bytes on the GPU", size),
    ("texture_psnr_db", "Texture PSNR", decibels),
    ("picture_psnr_db", "Picture PSNR", decibels),
    ("pages_bytes", "Page file", size),
)


def in_unit(value: float | None, unit: str) -> str:
    """A length in words, with the scan's unit."""
    return NOT_MEASURED if value is None else f"{number(value)} {unit}"


def setting(value) -> str:
    """A setting's value as it is typed."""
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def mean_pass_seconds(views: list[dict], key: str) -> dict[str, float]:
    """Mean seconds of each render pass over the views that have them; `key` is seconds or baseline_seconds."""
    timed = [view[key] for view in views if view[key]]
    return {name: sum(seconds[name] for seconds in timed) / len(timed) for name in (timed[0] if timed else ())}


NUMERICS = {  # key: what was met, one and many; what was done about it
    "dropped_points": ("point has", "points have", "a position that is not finite", "dropped"),
    "degenerate_normals": (
        "splat has",
        "splats have",
        "no normal of the scan's, and a neighbourhood that defines none",
        "given a normal at right angles to what there is",
    ),
    "flagged_projections": (
        "splat is",
        "splats are",
        "not seen whole by any one photograph",
        "coloured by the scan, or by the photograph's edge repeated",
    ),
    "replaced_atoms": (
        "atom was",
        "atoms were",
        "hardly used, or nearly another",
        "replaced by badly represented textures",
    ),
    "safeguard_steps": ("dictionary did", "dictionaries did", "worse than the best before", "the best was kept"),
}


def numerics(figures: dict) -> list[str]:
    """What hard cases were met and what was done about them, a sentence each.

    >>> numerics({"dropped_points": 1, "replaced_atoms": 0, "accumulation": "RGBA32F"})[0]
    '1 point has a position that is not finite: dropped.'
    """
    met = [(NUMERICS[key], figures[key]) for key in NUMERICS if figures.get(key)]
    said = [f"{number(n)} {one if n == 1 else many} {what}: {done}." for (one, many, what, done), n in met]
    if figures.get("accumulation") == "RGBA32F":
        said.append(
            "So many splats lie on top of each other that 16-bit sums of their colours would show: added up in 32 bits."
        )
    elif figures.get("accumulation") == "RGBA16F, as asked for":
        said.append("Colours were added up in 16 bits a channel, as asked for; nobody looked whether this shows.")
    elif figures.get("accumulation"):
        said.append("Colours were added up in 16 bits a channel; no pixel has so many splats that this would show.")
    if not met and any(figures.get(key) is not None for key in NUMERICS):
        said.insert(0, "No point, normal, projection or atom called for special care.")
    return said


def summary(report: dict) -> str:
    """The report in two sentences."""
    scan, sizes = report["scan"], report["sizes"]
    points, cameras, shipped = scan.get("n_points"), scan.get("n_cameras"), sizes["shipped_bytes"]
    source = f"{number(points)} points" if points else "The points"
    source += f" and {number(cameras)} photographs" if cameras else ", without photographs,"
    first = (
        f"{source} became {number(report['splats'])} splats, which take {size(sizes['gpu_bytes'] - shipped)} of GPU memory: "
        f"{sizes['own_bytes_per_splat']:.2f} bytes a splat."
    )
    if shipped:
        first += (
            f" Beside them stand {size(shipped)} of atoms that ship with the program, as many for any scan; the file "
            "has none."
        )
    if sizes["maps_bytes"]:
        return f"{first} {size(sizes['maps_bytes'])} of them are pictures of what the stations saw, where splats look up their colours."
    if sizes["compression_factor_total"] is None and sizes["dictionary_bytes"]:
        return f"{first} {size(sizes['dictionary_bytes'])} of them are the dictionary of their textures."
    if sizes["compression_factor_total"] is None:
        return f"{first} Every splat has one colour; there is no dictionary."
    return (
        f"{first} With the photographs as textures the same splats would take "
        f"{size(sizes['source_texture_bytes'] + sizes['geometry_bytes'])}, "
        f"{factor(sizes['own_factor_total'])[:-2]} times as much{' as without these atoms' if shipped else ''}."
    )


def texture_figures(sizes: dict) -> tuple[tuple[str, str, str], ...]:
    """QUALITY of what has textures: all of it with photographs, the texture PSNR alone of laser stations."""
    if sizes["source_texture_bytes"] is not None:
        return QUALITY
    if not (sizes["maps_bytes"] or sizes["dictionary_bytes"]):
        return ()
    return ((*QUALITY[0][:2], OF_STATIONS[sizes["maps_bytes"] > 0]),)


FILTERS: dict[str, Callable] = {
    f.__name__: f for f in (decibels, similarity, factor, percent, number, size, duration, in_unit, setting)
}
