"""Which stages a laser scan has that is textured from the maps of its stations themselves, and which it has not."""

from __future__ import annotations

from pipeline.catalogue import CATALOGUE, Phase

OF_MAPS = {"panoramas", "station-light", "map-cliplines", "map-pictures", "mapped-splats"}
OF_PATCHES = {entry.name for entry in CATALOGUE if entry.phase == Phase.LEARNING} | {
    *("photographs", "nearest-points", "cliplines", "exposure", "depth-maps"),
    *("resample", "colors", "training-set", "quantise", "multipliers", "encode", "photo-pages"),
}


def told_by_stations(name: str, n_stations: int) -> bool | None:
    """Whether a stage is called for; None where that does not go by stations."""
    if name in OF_MAPS:
        return n_stations > (1 if name == "station-light" else 0)
    return False if n_stations and name in OF_PATCHES else None
