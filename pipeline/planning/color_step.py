"""How large cells of average colours may be."""

from __future__ import annotations

from pipeline.planning.settings import Settings
from pipeline.texture.colors import step_for

# 255ths that cells of average colours may span at 40 dB, and in proportion to the error elsewhere: with 2 and 2.6
# `balanced` of fountain_p11 has 40.52 and 40.47 dB at 5.00 and 4.90 bytes of textures; an atom's bytes would take 0.04
# for that. Beyond the last, flat walls show them.
COLOR_STEP_AT_40_DB, MOST_COLOR_STEP = 2.5, 3.2


def color_step(settings: Settings) -> int:
    """The code of the largest cell of average colours; 0, whole bytes, for the paper's coder."""
    return (
        0
        if settings.coder == "paper"
        else step_for(min(MOST_COLOR_STEP, COLOR_STEP_AT_40_DB * 10 ** ((40 - settings.target_psnr_db) / 20)))
    )
