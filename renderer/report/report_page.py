"""The quality report as one page that needs nothing but itself: plots, pictures, styles and scripts are inside."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import jinja2
from bokeh.embed import components
from bokeh.resources import Resources
from markupsafe import Markup

from pipeline.readers.photos import decode_photo
from renderer.files import write_whole
from renderer.pictures import data_uri, jpeg_within, png_uri
from renderer.report import report_plots, report_words
from renderer.report.dictionary_picture import dictionary_picture
from storage.packed.packed import PackedScene

PAGE_NAME = "report.html"
# As base64 12 MB, the close-ups of edges included; with 1.3 MB of Bokeh and at most 1.1 MB of dictionary a page stays
# under 15 MB.
ALL_PICTURES_BYTES = 8_400_000
ONE_PICTURE_BYTES = 400_000
EDGE_PICTURE_BYTES = 50_000  # three pictures of 448 px a close-up, four close-ups
MAP_PICTURE_BYTES = 60_000  # at most twelve


def write_page(folder: Path, report: dict, scene: PackedScene) -> Path:
    """Write `report.html` into a folder; it appears whole.

    `report` is what `build_report` returned; the pictures of its views are read from `folder`. `scene` gives the atoms
    of the dictionary, most used first; of a large file it is some of its groups.

    Guarantees: the page loads nothing from anywhere; every text of the user's stands in it escaped; under 15 MB.
    """
    path = Path(folder) / PAGE_NAME
    write_whole(path, page_of(report, scene, Path(folder)).encode("utf-8", errors="replace"))
    return path


def page_of(report: dict, scene: PackedScene, folder: Path) -> str:
    """The text of the page; see `write_page`."""
    views, plots = report["quality"]["views"], _plots(report)
    script, divs = components(plots) if plots else ("", {})
    dictionary = dictionary_picture(scene)
    return template("report.html.jinja").render(
        report=report,
        scan=report["scan"],
        sizes=report["sizes"],
        quality=report["quality"],
        views=views,
        summary=report_words.summary(report),
        parts=report_words.parts_of(scene.header.geometry, report["sizes"]),
        part_colors=report_plots.PART_COLORS,
        series=report_plots.SERIES,
        figures=report_words.texture_figures(report["sizes"]),
        geometry_figures=report_words.geometry_figures(report),
        table_1=report_words.TABLE_1,
        numerics=report_words.numerics(report["numerics"]),
        estimate_figures=report_words.ESTIMATE,
        passes=report_words.PASSES,
        pass_seconds=report_words.mean_pass_seconds(views, "seconds"),
        baseline_seconds=report_words.mean_pass_seconds(views, "baseline_seconds"),
        pictures=_embedded(views, folder, _bytes_a_picture(views)),
        edges=_embedded(report["edges"], folder, EDGE_PICTURE_BYTES),
        maps=_embedded(report["stations"], folder, MAP_PICTURE_BYTES),
        station_views=[_embedded(row["views"], folder, EDGE_PICTURE_BYTES) for row in report["stations"]],
        dictionary=Markup(png_uri(dictionary)) if dictionary is not None else None,
        n_dictionary=scene.header.n_dictionary,
        n_looked_at=scene.header.n_splats,
        bokeh=Markup(Resources(mode="inline", components=["bokeh"]).render()),
        plot_script=Markup(script),
        plots={name: Markup(div) for name, div in divs.items()},
    )


def template(name: str) -> jinja2.Template:
    """One of templates/, with the filters of `report_words` and the style of all pages."""
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(report_words.FILTERS)
    folder = files("renderer").joinpath("templates")
    environment.globals["style"] = Markup(folder.joinpath("style.css").read_text(encoding="utf-8").strip())
    return environment.from_string(folder.joinpath(name).read_text(encoding="utf-8"))


def _plots(report: dict) -> dict:
    """The figures that this report has data for, by the names the template knows."""
    stages = report["stages"]
    plots = {"parts": report_plots.part_bar(report["sizes"], report["splats"])}
    if report["sizes"]["dictionary_bytes"]:
        plots["atoms"] = report_plots.atom_bars(report["atoms"]["histogram"])
    if report["learning"] and report["sizes"]["dictionary_bytes"]:
        plots["learning"] = report_plots.learning_curve(report["learning"])
    if stages:
        plots["seconds"] = report_plots.stage_bars(stages, "seconds", "seconds", 1, report_plots.BLUE)
        plots["memory"] = report_plots.stage_bars(stages, "peak_rss_bytes", "peak memory, MB", 1e6, report_plots.AMBER)
    if any(view[key] is not None for view in report["quality"]["views"] for key, *_ in report_plots.SERIES):
        plots["views"] = report_plots.view_dots(report["quality"]["views"])
    return plots


def _bytes_a_picture(views: list[dict]) -> int:
    return min(ONE_PICTURE_BYTES, ALL_PICTURES_BYTES // max(1, sum(len(view["pictures"]) for view in views)))


def _embedded(rows: list[dict], folder: Path, max_bytes: int) -> list[dict[str, Markup]]:
    """For every row its pictures by kind, as data URIs of JPEGs small enough for the page."""
    return [
        {
            kind: Markup(data_uri(jpeg_within(decode_photo(str(folder / path), path), max_bytes), "image/jpeg"))
            for kind, path in row["pictures"].items()
        }
        for row in rows
    ]
