"""Splats of which a map shows little are marked where a scan has many of them."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.maps import mapped_splats
from pipeline.stages.maps.mapped_splats import CALLED_FOR_FROM, StationsChosen, stations_in_file
from storage.maps import IN_PART, NO_MAP
from storage.work import arrays


@pytest.mark.parametrize(("n_in_part", "marked"), [(99, False), (100, True)])
def test_stations__are_marked_from_one_percent_on(tmp_path, monkeypatch, n_in_part, marked):
    chosen = StationsChosen(n_blind=1, n_in_part=n_in_part, n_splats=int(100 / CALLED_FOR_FROM))
    monkeypatch.setattr(mapped_splats.work, "summary", lambda folder, kind: chosen)
    found = np.array([0, 1, IN_PART, IN_PART + 1, NO_MAP], np.uint8)
    arrays.store(tmp_path, "station", found, found.shape)
    plain = np.array([0, 1, 0, 1, NO_MAP], np.uint8)
    assert (stations_in_file(tmp_path, 0, 5) == (found if marked else plain)).all()
    assert (stations_in_file(tmp_path, 3, 5) == (found if marked else plain)[3:]).all()
