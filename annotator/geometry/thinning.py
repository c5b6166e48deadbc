"""Fewer points that look like all of them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float64, Int64

# Which point of a run is kept; any number does, always the same one keeps a frame looking the same.
SEED = 20231


def thin(n_points: int, most: int) -> Int64[np.ndarray, "m"] | None:
    """Numbers of the points that are kept, ascending; None = all of them.

    One point at random of each of `most` equal runs. Points that follow each other in a scan or an image lie next to
    each other, so the picture thins out evenly; and it costs nothing for any size of cloud.
    """
    if n_points <= most:
        return None
    edges = np.arange(most + 1, dtype=np.int64) * n_points // most
    return edges[:-1] + (_places(most) * np.diff(edges)).astype(np.int64)


@lru_cache(maxsize=8)
def _places(most: int) -> Float64[np.ndarray, "m"]:
    """Where in its run each kept point lies, from 0 to 1."""
    return np.random.default_rng(SEED).random(most)
