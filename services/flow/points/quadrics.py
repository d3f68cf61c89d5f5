"""The geometry of a scan's splats over quadrics, where it is asked for or fewer bytes than boxes at the asked error."""

from __future__ import annotations

from pipeline.effects.plan.plan import Row
from pipeline.geometry.quadrics.codes import ERROR, NORMAL_ERROR
from pipeline.summaries import SplatsMade
from services.flow.points.runs import AUTO, BOX_BITS, GeometryRequest
from storage.packed.schema import CHUNK, QUADRICS

FRAME_BITS = 8 * 32 / CHUNK  # a splat, of its chunk's frame on a graphics card
SIZE_BITS = 3 + 16 / CHUNK  # a splat in boxes that has a size of its own, which numbers over quadrics have already


def quadric_error(asked: GeometryRequest) -> tuple[float, float] | None:
    """The mean errors over quadrics, of positions in radii and of normals in degrees; None where boxes are meant."""
    if asked.form == QUADRICS or (asked.form == AUTO and asked.error):
        return asked.error or ERROR, asked.normal_error or NORMAL_ERROR
    return None


def quadrics_row(asked: GeometryRequest, made: SplatsMade, with_sizes: bool) -> Row:
    """The row of the plan: bits a splat over quadrics by those of boxes, before numbers are sorted by batches, which
    takes up to 5 away."""
    of_boxes = BOX_BITS + (SIZE_BITS if with_sizes else 0)
    share = (made.number_bits + FRAME_BITS) / of_boxes
    is_asked = asked.form == QUADRICS
    enabled = is_asked or share < 1
    return Row(
        "geometry_quadrics",
        "positions and normals as one number over a quadric that is fitted to each chunk, in the place of boxes",
        "on" if is_asked else AUTO,
        enabled,
        1.0,
        share,
        f"bits a splat by those of boxes, at a mean error of {made.mean_error_in_radii:.3g} radii",
        1.0,
        "asked to be on" if is_asked else f"{share:.2g} {'is below' if enabled else 'reaches'} 1",
        "fewer bytes at the error that is asked for",
        {
            "seconds": 7e-6 * made.n_splats,
            "bytes": round((share - 1) * of_boxes / 8 * made.n_splats),
            "frame_share": 0.0,
        },
        None,
        "fountain_p11, stanford_dragon, pump_e57",
    )
