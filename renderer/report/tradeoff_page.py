"""The ladder of `splatpress tradeoff` as data and as one page that needs nothing but itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bokeh.embed import components
from bokeh.models import CustomJS, HoverTool, TapTool
from bokeh.plotting import figure
from bokeh.resources import Resources
from markupsafe import Markup
from msgspec import to_builtins

from pipeline.numerics.accuracy import BEST_DB
from pipeline.planning.knobs import BY_NAME
from pipeline.readers.photos import decode_photo
from renderer.files import strict, write_json, write_whole
from renderer.pictures import png_uri
from renderer.report.report_page import template
from renderer.report.report_plots import AMBER, BLUE, MUTED, plain_figure, source_of
from renderer.report.tradeoff_document import Advice, Beaten, LadderPoint, LadderSummary, TradeoffDocument

TRADEOFF_NAME, TRADEOFF_PAGE = "tradeoff.json", "tradeoff.html"
COSTS = (  # key, axis, what it is in a sentence, the scale of the axis
    ("file_bytes", "megabytes of the file", "bytes", 1e-6),
    ("seconds", "seconds of compressing", "seconds", 1.0),
    ("frame_seconds", "milliseconds of a frame", "frame time", 1e3),
)
TEXTURE, PICTURE = "texture_psnr_db", "picture_psnr_db"
QUALITIES = {TEXTURE: "texture PSNR, dB", PICTURE: "PSNR of pictures, dB"}
WANTED_DB = (30.0, 32.0, 34.0, 36.0, 38.0, 40.0, 42.0, 44.0, 46.0)
LEAD_DB = 40.0
NOISE_DB, NOISE_SHARE = 0.05, 0.05  # a preset that another beats by less than both is as good


def summarised(points: Sequence[LadderPoint]) -> LadderSummary:
    """The Pareto fronts of points, what to take for which quality, and which presets another one beats.

    Fronts are of picture PSNR, which points of any number of splats share. Texture PSNR is of a point's own splats:
    where pictures were not measured fronts are of it, and advice always is, among the points of as many splats as the
    first."""
    alike = [p for p in points if p.splats == points[0].splats and p.texture_psnr_db is not None]
    quality = quality_of(points)
    compared = points if quality == PICTURE else alike
    costs = [cost for cost, *_ in COSTS if all(getattr(p, cost) is not None for p in points)]
    presets = [p for p in alike if p.preset]
    return LadderSummary(
        {cost: tuple(pareto(compared, cost, quality)) for cost in costs},
        tuple(Beaten(a.preset, b.preset) for a in presets for b in presets if a is not b and _beats(b, a)),
        tuple(row for wanted in WANTED_DB if (row := advised(alike, wanted))),
    )


def quality_of(points: Sequence[LadderPoint]) -> str:
    """By what points are compared: their picture PSNR, where it was measured of all."""
    return PICTURE if all(p.picture_psnr_db is not None for p in points) else TEXTURE


def pareto(points: Sequence[LadderPoint], cost: str, quality: str = TEXTURE) -> list[str]:
    """Keys of the points that no other beats in both cost and quality, the cheapest first."""
    front, best = [], float("-inf")
    for point in sorted(points, key=lambda p: (getattr(p, cost), -getattr(p, quality))):
        if getattr(point, quality) > best:
            front.append(point.key)
            best = getattr(point, quality)
    return front


def advised(points: Sequence[LadderPoint], wanted_db: float) -> Advice | None:
    """For a texture PSNR, the preset of fewest bytes that reaches it and the point of fewest bytes of all, by key."""
    reach = sorted((p for p in points if p.texture_psnr_db >= wanted_db), key=lambda p: (p.file_bytes, p.seconds))
    if not reach or min(p.texture_psnr_db for p in points) >= wanted_db + 2:
        return None
    return Advice(wanted_db, next((p.key for p in reach if p.preset), None), reach[0].key)


def leading(advice: list[dict]) -> list[dict]:
    """What is said first: 40 dB, which is 1 % of error, and the step after it; else the last two that can be had."""
    first = max(0, next((i for i, row in enumerate(advice) if row["wanted_db"] >= LEAD_DB), len(advice) - 2))
    return advice[first : first + 2]


def _beats(b: LadderPoint, a: LadderPoint) -> bool:
    """Whether b is better than a in bytes, seconds and PSNR by more than noise in one of them, and worse in none."""
    worse = (
        b.texture_psnr_db < a.texture_psnr_db - NOISE_DB
        or b.file_bytes > a.file_bytes * (1 + NOISE_SHARE)
        or b.seconds > a.seconds * (1 + NOISE_SHARE)
    )
    better = (
        b.texture_psnr_db > a.texture_psnr_db + NOISE_DB
        or b.file_bytes < a.file_bytes * (1 - NOISE_SHARE)
        or b.seconds < a.seconds * (1 - NOISE_SHARE)
    )
    return better and not worse


def write_tradeoff(folder: Path, document: TradeoffDocument) -> None:
    """tradeoff.json and tradeoff.html, each whole; the pictures that the document names are read from the folder."""
    told = strict(to_builtins(document))
    write_json(folder / TRADEOFF_NAME, told)
    page = page_of(told, quality_of(document.points), folder)
    write_whole(folder / TRADEOFF_PAGE, page.encode("utf-8", errors="replace"))


def page_of(document: dict, quality: str, folder: Path) -> str:
    """The text of the page of tradeoff.json, whose points are compared by `quality`; see `write_tradeoff`."""
    points = {p["key"]: p | {"number": i, "label": _label(p)} for i, p in enumerate(document["points"], 1)}
    plots = {
        cost: _plot(list(points.values()), document["fronts"][cost], cost, axis, scale, quality)
        for cost, axis, _, scale in COSTS
        if cost in document["fronts"]
    }
    if "frame_seconds" in document["fronts"]:
        plots["atoms"] = _frame_plot(list(points.values()))
    script, divs = components(plots)
    advice = _in_words(document, points)
    return template("tradeoff.html.jinja").render(
        t=document,
        points=list(points.values()),
        chosen=document["points"][0],
        quality=quality,
        advice=advice,
        lead=leading(advice),
        knobs=_knob_rows(document["points"]),
        pictures=_pictures_by_point(document, folder),
        fronts={cost: set(keys) for cost, keys in document["fronts"].items()},
        bokeh=Markup(Resources(mode="inline", components=["bokeh"]).render()),
        plot_script=Markup(script),
        plots={name: Markup(div) for name, div in divs.items()},
    )


def _label(point: dict) -> str:
    return point["preset"] or point["key"]


def _in_words(document: dict, points: dict[str, dict]) -> list[dict]:
    """The advice with its points, and what each costs against the row before it."""
    rows, before = [], None
    for row in document["advice"]:
        take = points[row["preset"] or row["cheapest"]]
        rows.append(
            row
            | {
                "take": take,
                "cheapest": points[row["cheapest"]],
                "more": before
                and {cost: take[cost] / before[cost] - 1 for cost, *_ in COSTS if take[cost] and before[cost]},
            }
        )
        before = take
    return rows


def _knob_rows(points: list[dict]) -> list[dict]:
    """Each knob with its points and the chosen one among them, by value, and their differences from the chosen one."""
    chosen, rows = points[0], []
    for name in dict.fromkeys(p["knob"] for p in points if p["knob"]):
        tried = [p for p in points if p["knob"] == name] + [chosen | {"value": chosen["settings"][name]}]
        values = sorted(tried, key=lambda p: (isinstance(p["value"], str), p["value"] is not None, p["value"] or 0))
        rows.append(
            {
                "knob": BY_NAME[name],
                "points": [
                    p
                    | {
                        "is_chosen": p["key"] == chosen["key"],
                        "more_db": p[TEXTURE] - chosen[TEXTURE] if chosen[TEXTURE] is not None else None,
                        "is_alike": p["splats"] == chosen["splats"] and chosen[TEXTURE] is not None,
                        "more": {cost: p[cost] / chosen[cost] - 1 for cost, *_ in COSTS if p[cost] and chosen[cost]},
                    }
                    for p in values
                ],
            }
        )
    return rows


def _pictures_by_point(document: dict, folder: Path) -> dict[str, list[dict]]:
    """By point, a picture a spot with its figures; the photographs' under the name they have there."""
    found: dict[str, list[dict]] = {}
    for row in document["close_ups"]:
        for name, path in row["pictures"].items():
            picture = Markup(png_uri(decode_photo(str(folder / path), path)))
            found.setdefault(name, []).append({"why": row["why"], "picture": picture, "figures": row["figures"][name]})
    return found


def _plot(points: list[dict], front: list[str], cost: str, axis: str, scale: float, quality: str) -> figure:
    """PSNR over a cost, the front as a line, presets named; a click on a point shows its pictures. What the others are
    compared with is no dot."""
    points = [p for p in points if p[quality] < BEST_DB] or points
    plot = plain_figure(340, x_axis_label=axis, y_axis_label=QUALITIES[quality])
    on = sorted((p for p in points if p["key"] in front), key=lambda p: p[cost])
    plot.x_range.range_padding = 0.15  # room for the names
    plot.line([p[cost] * scale for p in on], [p[quality] for p in on], color=AMBER, width=2)
    _dots(plot, points, [p[cost] * scale for p in points], [p[quality] for p in points], axis)
    return plot


def _frame_plot(points: list[dict]) -> figure:
    plot = plain_figure(340, x_axis_label="atoms of a splat, on average", y_axis_label="milliseconds of a frame")
    _dots(plot, points, [p["mean_atoms"] for p in points], [1e3 * p["frame_seconds"] for p in points], "atoms a splat")
    plot.x_range.range_padding = 0.15
    plot.y_range.start = 0
    return plot


def _dots(plot: figure, points: list[dict], x: list[float], y: list[float], axis: str) -> None:
    source = source_of(
        {
            "x": x,
            "y": y,
            "label": [p["label"] for p in points],
            "number": [p["number"] for p in points],
            "color": [BLUE if p["preset"] else MUTED for p in points],
            "size": [13 if p["preset"] else 8 for p in points],
        }
    )
    dots = plot.scatter("x", "y", source=source, color="color", size="size", nonselection_alpha=1.0)
    named = [(v, w, p["label"], v > (min(x) + max(x)) / 2) for v, w, p in zip(x, y, points) if p["preset"]]
    plot.text(
        "x",
        "y",
        text="label",
        x_offset="off",
        text_align="align",
        source=source_of(
            {
                "x": [v for v, *_ in named],
                "y": [w for _, w, *_ in named],
                "label": [label for _, _, label, _ in named],
                "off": [-10 if right else 10 for *_, right in named],  # into the plot, whose edge would cut it
                "align": ["right" if right else "left" for *_, right in named],
            }
        ),
        y_offset=5,
        text_font_size="13px",
        text_color=BLUE,
    )
    plot.add_tools(HoverTool(renderers=[dots], tooltips=[("", "@label"), (axis, "@x{0.00}"), ("", "@y{0.00}")]))
    plot.add_tools(
        TapTool(
            renderers=[dots],
            callback=CustomJS(
                args={"source": source},
                code="""
        const at = source.selected.indices[0];
        if (at !== undefined) showPoint(source.data.number[at]);
    """,
            ),
        )
    )
