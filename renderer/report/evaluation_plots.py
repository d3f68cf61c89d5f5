"""The plots of the evaluation. Labels are our own words alone, as in `report_plots`."""

from __future__ import annotations

from bokeh.models import FixedTicker, HoverTool
from bokeh.palettes import Blues9
from bokeh.plotting import figure

from renderer.report.report_plots import AMBER, BLUE, GREEN, MUTED, ROSE, plain_figure, source_of

KIND_COLORS = {"ours": BLUE, "photos": AMBER, "pictures": MUTED, "atlas": ROSE}
CURVE_COLORS = (BLUE, AMBER, GREEN, ROSE, MUTED)


def bytes_and_psnr(rows: list[dict]) -> figure:
    """Every row that lost something: texture PSNR over all bytes of a splat."""
    plot = plain_figure(
        420, x_axis_label="bytes a splat, geometry among them", y_axis_label="texture PSNR, dB", x_axis_type="log"
    )
    for kind, color in KIND_COLORS.items():
        shown = [row for row in rows if row["kind"] == kind and row["texture_psnr_db"] is not None]
        if not shown:
            continue
        shown.sort(key=lambda row: row["bytes_per_splat"])
        source = source_of(
            {
                "x": [r["bytes_per_splat"] for r in shown],
                "y": [r["texture_psnr_db"] for r in shown],
                "name": [_name(r) for r in shown],
                **_places(shown, rows),
            }
        )
        dots = plot.scatter(
            "x", "y", source=source, color=color, size=10, marker="circle" if kind == "ours" else "square"
        )
        plot.text(
            "x",
            "y",
            text="name",
            source=source,
            x_offset="right",
            y_offset="down",
            text_align="align",
            text_font_size="12px",
            text_color=color,
        )
        plot.add_tools(
            HoverTool(
                renderers=[dots], tooltips=[("", "@name"), ("bytes a splat", "@x{0.00}"), ("PSNR", "@y{0.00} dB")]
            )
        )
    plot.x_range.range_padding = 0.25
    return plot


def _name(row: dict) -> str:
    return f"{row['name']} {row['coder']}" if row["kind"] == "ours" and row["n_dictionary"] else row["name"]


def _places(shown: list[dict], rows: list[dict]) -> dict[str, list]:
    """Where names stand: into the plot on its right side, whose edge would cut them; ours by turns above and below
    their dots, of others the best one above."""
    most = max(row["bytes_per_splat"] for row in rows if row["texture_psnr_db"] is not None)
    best = max(row["texture_psnr_db"] for row in shown)
    left = [row["bytes_per_splat"] > most / 1.6 for row in shown]
    return {
        "align": ["right" if at else "left" for at in left],
        "right": [-8 if at else 8 for at in left],
        "down": [
            -2 if (i % 2 if row["kind"] == "ours" else row["texture_psnr_db"] == best) else 14
            for i, row in enumerate(shown)
        ],
    }


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
    bars = plot.vbar_stack(
        [f"n{n}" for n in counts],
        x="target",
        width=1.6,
        source=source_of(data),
        line_color="white",
        color=[palette[n] for n in counts],
        legend_label=[f"{n} atoms" if n != 1 else "1 atom" for n in counts],
    )
    for n, bar in zip(counts, bars):
        plot.add_tools(
            HoverTool(renderers=[bar], tooltips=[("target", "@target dB"), (f"{n} atoms", f"@n{n}{{0.0}} %")])
        )
    plot.xaxis.ticker = FixedTicker(ticks=targets)
    plot.xgrid.visible = False
    plot.y_range.start, plot.y_range.end = 0, 100
    plot.add_layout(plot.legend[0], "right")
    plot.legend.border_line_color = None
    return plot
