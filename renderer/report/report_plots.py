"""The plots of the report, as Bokeh figures without toolbar. Axes carry numbers and our own words alone: a label from
a user's file could hold TeX, for which Bokeh would fetch a typesetter from outside."""

from __future__ import annotations

from bokeh.models import ColumnDataSource, FixedTicker, HoverTool, NumeralTickFormatter
from bokeh.plotting import figure

INK, MUTED, GRID = "#22303c", "#6b7a86", "#e3e8ec"
BLUE, AMBER, GREEN, ROSE = "#2b6f9e", "#d98e2b", "#4f8a5b", "#b0506a"
PART_COLORS = {"geometry": BLUE, "codes": AMBER, "colors": ROSE, "dictionary": GREEN, "maps": MUTED}
SERIES = (  # of each view: key, meaning, color, marker, and the marker as text for the legend
    ("psnr_vs_baseline_db", "packed against baseline", BLUE, "circle", "●"),
    ("psnr_vs_photo_db", "packed against photo", AMBER, "square", "■"),
    ("baseline_psnr_vs_photo_db", "baseline against photo", MUTED, "triangle", "▲"),
)


def part_bar(sizes: dict, n_splats: int) -> figure:
    """One bar: the bytes of a splat, part by part."""
    plot = plain_figure(110, x_axis_label="bytes a splat")
    left = 0.0
    for part, color in PART_COLORS.items():
        width = sizes[f"{part}_bytes"] / n_splats
        data = {"left": [left], "right": [left + width], "part": [part], "width": [width]}
        plot.hbar(y=0, left="left", right="right", height=1, source=source_of(data), color=color, line_color="white")
        left += width
    plot.add_tools(HoverTool(tooltips=[("part", "@part"), ("bytes a splat", "@width{0.00}")]))
    plot.yaxis.visible = False
    plot.ygrid.visible = False
    plot.x_range.start = 0
    return plot


def atom_bars(histogram: list[int]) -> figure:
    """How many splats have how many atoms, in per cent."""
    total = sum(histogram)
    data = {"n_atoms": list(range(len(histogram))), "splats": histogram, "share": [100 * n / total for n in histogram]}
    plot = plain_figure(260, x_axis_label="atoms of a splat", y_axis_label="splats, %")
    plot.vbar(x="n_atoms", top="share", width=0.8, source=source_of(data), color=BLUE)
    plot.add_tools(HoverTool(tooltips=[("atoms", "@n_atoms"), ("splats", "@splats{0,0}"), ("share", "@share{0.0} %")]))
    plot.xaxis.ticker = FixedTicker(ticks=data["n_atoms"])
    plot.xgrid.visible = False
    plot.y_range.start = 0
    return plot


def learning_curve(learning: list[dict]) -> figure:
    """PSNR over the seconds of learning, a dot for each pass with exact weights, as the paper's Figure 7."""
    data = {
        "seconds": [entry["seconds"] for entry in learning],
        "psnr": [entry["psnr_db"] for entry in learning],
        "replaced": [entry.get("replaced_atoms") for entry in learning],
        "pass": list(range(1, len(learning) + 1)),
    }
    plot = plain_figure(
        260, x_axis_label="seconds of passes with exact weights", y_axis_label="PSNR of training patches, dB"
    )
    source = source_of(data)
    plot.line("seconds", "psnr", source=source, color=BLUE, width=2)
    dots = plot.scatter("seconds", "psnr", source=source, color=BLUE, size=8)
    plot.add_tools(
        HoverTool(
            renderers=[dots],
            tooltips=[
                ("pass", "@pass"),
                ("seconds", "@seconds{0.0}"),
                ("PSNR", "@psnr{0.00} dB"),
                ("atoms replaced", "@replaced"),
            ],
        )
    )
    plot.x_range.start = 0
    return plot


def stage_bars(stages: list[dict], key: str, label: str, scale: float, color: str) -> figure:
    """One bar a stage, the first on top; `key` is what is shown, divided by `scale`."""
    data = {
        "row": list(range(len(stages))),
        "name": [stage["name"] for stage in stages],
        "value": [(stage[key] or 0) / scale for stage in stages],
    }
    plot = plain_figure(60 + 26 * len(stages), x_axis_label=label, y_range=(len(stages) - 0.5, -0.5))
    plot.hbar(y="row", right="value", height=0.7, source=source_of(data), color=color)
    plot.yaxis.ticker = FixedTicker(ticks=data["row"])
    plot.yaxis.major_label_overrides = dict(enumerate(data["name"]))
    plot.add_tools(HoverTool(tooltips=[("stage", "@name"), (label, "@value{0,0.00}")]))
    plot.ygrid.visible = False
    plot.x_range.start = 0
    return plot


def view_dots(views: list[dict]) -> figure:
    """PSNR of every view, numbered from 1 as in the table below it; the page has the legend."""
    plot = plain_figure(260, x_axis_label="view", y_axis_label="PSNR, dB")
    for key, meaning, color, marker, _ in SERIES:
        shown = [(i, view[key]) for i, view in enumerate(views, 1) if view.get(key) is not None]
        if shown:
            number, psnr = zip(*shown)
            source = source_of({"number": number, "psnr": psnr, "what": [meaning] * len(shown)})
            plot.scatter("number", "psnr", source=source, color=color, marker=marker, size=10)
    plot.add_tools(HoverTool(tooltips=[("view", "@number"), ("", "@what"), ("PSNR", "@psnr{0.0} dB")]))
    plot.xaxis.ticker = FixedTicker(ticks=list(range(1, len(views) + 1)))
    return plot


def source_of(data: dict) -> ColumnDataSource:
    """Columns as Bokeh takes them."""
    return ColumnDataSource({key: list(values) for key, values in data.items()})


def plain_figure(height_px: int, **options) -> figure:
    """A figure in the report's dress: no frame, no tools, as wide as its place."""
    plot = figure(height=height_px, sizing_mode="stretch_width", toolbar_location=None, tools="", **options)
    plot.outline_line_color = None
    plot.background_fill_alpha = plot.border_fill_alpha = 0
    plot.grid.grid_line_color = GRID
    plot.axis.axis_line_color = plot.axis.major_tick_line_color = GRID
    plot.axis.minor_tick_line_color = None
    plot.axis.major_label_text_color = plot.axis.axis_label_text_color = MUTED
    plot.axis.major_label_text_font_size = plot.axis.axis_label_text_font_size = "13px"
    plot.axis.axis_label_text_font_style = "normal"
    for axis in plot.xaxis:
        if hasattr(axis.formatter, "use_scientific"):
            axis.formatter = NumeralTickFormatter(format="0,0.[00]")
    return plot
