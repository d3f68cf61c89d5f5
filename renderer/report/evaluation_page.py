"""The evaluation as data and as one page that needs nothing but itself, the paper's figures beside ours."""

from __future__ import annotations

from pathlib import Path

import msgspec
from bokeh.embed import components
from bokeh.resources import Resources
from markupsafe import Markup

from pipeline.readers.photos import decode_photo
from renderer.files import strict, write_json, write_whole
from renderer.pictures import data_uri, jpeg_within, png_uri
from renderer.report import evaluation_plots
from renderer.report.evaluation_document import EvaluationDocument
from renderer.report.report_page import template

EVALUATION_NAME, EVALUATION_PAGE = "evaluate.json", "evaluate.html"
PICTURE_BYTES = 250_000

# HPG 2021, Table 1, by row: bytes a splat, factor in all, factor of the textures, texture PSNR in dB.
PAPER_TABLE_1 = {
    "lod0": (233.2, 1.0, 1.0, None),
    "lod0-bc7": (83.5, 2.8, 2.9, 45.59),
    "lod0-bc1": (46.2, 5.0, 5.7, 40.04),
    "lod1": (64.9, 3.6, 3.9, 38.47),
    "lod1-bc7": (27.5, 8.5, 10.9, 36.55),
    "lod1-bc1": (18.2, 12.8, 20.1, 35.07),
    "d8w4": (14.0, 16.7, 31.2, 38.10),
    "d12w4": (15.1, 15.5, 27.1, 39.09),
    "d16w8": (24.1, 9.7, 13.0, 41.36),
    "per-splat": (4102.8, None, None, None),
}
# HPG 2021, Table 3: milliseconds of the attribute pass from three views, on a GeForce GTX 1080.
PAPER_ATTRIBUTE_MS = {
    "lod1": (7.50, 6.06, 9.38),
    "d8w4": (6.67, 6.57, 5.70),
    "d12w4": (6.85, 6.96, 5.77),
    "d16w8": (13.79, 13.75, 9.01),
}


def write_evaluation(folder: Path, document: EvaluationDocument) -> None:
    """evaluate.json and evaluate.html, each whole; the pictures that the document names are read from the folder."""
    plain = strict(msgspec.to_builtins(document))
    write_json(folder / EVALUATION_NAME, plain)
    write_whole(folder / EVALUATION_PAGE, page_of(plain, folder).encode("utf-8", errors="replace"))


def page_of(document: dict, folder: Path) -> str:
    """The text of the page; see `write_evaluation`."""
    rows = document["rows"]
    plots = (
        {"psnr": evaluation_plots.bytes_and_psnr(rows)} if any(r["texture_psnr_db"] is not None for r in rows) else {}
    )
    if (curves := evaluation_plots.learning_curves(rows)) is not None:
        plots["learning"] = curves
    if document["atoms"]:
        plots["atoms"] = evaluation_plots.atoms_by_target(document["atoms"])
    script, divs = components(plots) if plots else ("", {})
    return template("evaluate.html.jinja").render(
        e=document,
        rows=[row | {"paper": PAPER_TABLE_1.get(_paper_key(row["key"]))} for row in rows],
        passes=_pass_rows(document["passes"]),
        close_ups=[_embedded_close_up(row, folder) for row in document["close_ups"]],
        held_out=_embedded_held_out(document["held_out"], folder),
        bokeh=Markup(Resources(mode="inline", components=["bokeh"]).render()),
        plot_script=Markup(script),
        plots={name: Markup(div) for name, div in divs.items()},
    )


def _paper_key(key: str) -> str:
    """The published row that a row reproduces: that of the published coder, where there are several."""
    return key.removesuffix("-paper")


def _pass_rows(passes: list[dict]) -> list[dict]:
    """With what each pass takes against the first row's, and the paper's ratio of the attribute pass to its LOD 1."""
    rows = []
    by_name = {row["name"]: row for row in passes}
    for row in passes:
        beside = by_name.get("photos LOD 1", passes[0])["seconds"]
        key = {"photos LOD 1": "lod1"}.get(row["name"], row["name"].split()[0].lower())
        paper = PAPER_ATTRIBUTE_MS.get(key)
        rows.append(
            row
            | {
                "ratio": row["seconds"]["attribute"] / beside["attribute"],
                "total": sum(row["seconds"].values()),
                "paper": sum(paper) / sum(PAPER_ATTRIBUTE_MS["lod1"]) if paper else None,
            }
        )
    return rows


def _embedded_close_up(row: dict, folder: Path) -> dict:
    pictures = {name: Markup(png_uri(decode_photo(str(folder / path), path))) for name, path in row["pictures"].items()}
    return row | {"pictures": pictures}


def _embedded_held_out(held_out: dict | None, folder: Path) -> dict | None:
    if held_out is None:
        return None
    views = [
        view
        | {
            "pictures": {
                kind: Markup(data_uri(jpeg_within(decode_photo(str(folder / path), path), PICTURE_BYTES), "image/jpeg"))
                for kind, path in view["pictures"].items()
            }
        }
        for view in held_out["views"]
    ]
    return held_out | {"views": views}
