"""The plots of the evaluation. Labels are our own words alone, as in `report_plots`."""

from __future__ import annotations

from bokeh.models import FixedTicker, HoverTool, LabelSet
from bokeh.palettes import Blues9
from bokeh.plotting import figure

from renderer.report_plots import AMBER, BLUE, GREEN, MUTED, ROSE, plain_figure, source_of

KIND_COLORS = {"ours": BLUE, "photos": AMBER, "pictures": MUTED, "atlas": ROSE}
CURVE_COLORS = (BLUE, AMBER, GREEN, ROSE, MUTED)


def bytes_and_psnr(rows: list[dict]) -> figure:
    """Every row that lost something: texture PSNR over all bytes of a splat."""
    plot = plain_figure(420, x_axis_label="bytes a splat, geometry among them", y_axis_label="texture PSNR, dB", x_axis_type="log")
    for kind, color in KIND_COLORS.items():
        shown = [row for row in rows if row["kind"] == kind and row["texture_psnr_db"] is not None]
        if not shown:
            continue
        source = source_of({"x": [r["bytes_per_splat"] for r in shown], "y": [r["texture_psnr_db"] for r in shown],
                            "name": [r["name"] for r in shown]})
        dots = plot.scatter("x", "y", source=source, color=color, size=10, marker="circle" if kind == "ours" else "square")
        plot.add_layout(LabelSet(x="x", y="y", text="name", source=source, x_offset=8, y_offset=-6, text_font_size="12px",
                                 text_color=color))
        plot.add_tools(HoverTool(renderers=[dots], tooltips=[("", "@name"), ("bytes a splat", "@x{0.00}"), ("PSNR", "@y{0.00} dB")]))
    plot.x_range.range_padding = 0.25
    return plot


def learning_curves(rows: list[dict]) -> figure | None:
    """Figure 7: PSNR over seconds of learning, a dot a pass, for each dictionary."""
    learned = [row for row in rows if row.get("learning")]
    if not learned:
        return None
    plot = plain_figure(320, x_axis_label="seconds of learning", y_axis_label="PSNR of the scan as estimated, dB")
    for row, color in zip(learned, CURVE_COLORS * len(learned)):
        curve = row["learning"]
        source = source_of({"x": [e["seconds"] for e in curve], "y": [e["psnr_db"] for e in curve]})
        plot.line("x", "y", source=source, color=color, width=2, legend_label=f"{row['name']} {row['coder']}")
        plot.scatter("x", "y", source=source, color=color, size=7)
    plot.legend.location, plot.legend.border_line_color = "bottom_right", None
    plot.x_range.start = 0
    return plot


def atoms_by_target(atoms: dict) -> figure:
    """Figure 9: for each target a bar, in parts by how many atoms a splat takes."""
    targets, counts = atoms["targets_db"], range(len(atoms["histograms"][0]))
    data = {"target": targets, **{f"n{n}": [100 * h[n] / sum(h) for h in atoms["histograms"]] for n in counts}}
    plot = plain_figure(320, x_axis_label="target quality, dB", y_axis_label="splats, %")
    palette = ["#e3e8ec", *Blues9[-2::-1]]
    bars = plot.vbar_stack([f"n{n}" for n in counts], x="target", width=1.6, source=source_of(data), line_color="white",
                           color=[palette[n] for n in counts], legend_label=[f"{n} atoms" if n != 1 else "1 atom" for n in counts])
    for n, bar in zip(counts, bars):
        plot.add_tools(HoverTool(renderers=[bar], tooltips=[("target", "@target dB"), (f"{n} atoms", f"@n{n}{{0.0}} %")]))
    plot.xaxis.ticker = FixedTicker(ticks=targets)
    plot.xgrid.visible = False
    plot.y_range.start, plot.y_range.end = 0, 100
    plot.add_layout(plot.legend[0], "right")
    plot.legend.border_line_color = None
    return plot
