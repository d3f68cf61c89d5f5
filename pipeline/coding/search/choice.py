"""Which way a dictionary is searched: by how many atoms there are, and by whether few coefficients hold them."""

from __future__ import annotations

import numpy as np

from pipeline.coding.search.coarse import coarsen
from pipeline.coding.search.protocol import SearchedDictionary
from pipeline.coding.search.stepwise import shorten, unshortened
from pipeline.coding.search.whole import by_whole_products

SEARCHES = ("exact", "certified", "approximate")
# Up to here the rows of a k x k Gram matrix follow the residual: 1 GiB. Beyond, every step takes a GEMM of its own, and
# memory grows with k alone.
MOST_WITH_GRAM = 16384


def ready_for(search: str, dictionary: np.ndarray) -> SearchedDictionary:
    """A dictionary (k, d) float32 of unit rows, with what its `search`, one of SEARCHES, needs."""
    if len(dictionary) > MOST_WITH_GRAM:
        return (None if search == "exact" else shorten(dictionary)) or unshortened(dictionary)
    return (None if search == "exact" else coarsen(dictionary)) or by_whole_products(dictionary)
