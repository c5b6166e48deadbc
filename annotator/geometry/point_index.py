"""Thinning of clouds to a maximum number of points."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float64, Int64

# Arbitrary, but fixed, so that a frame is always drawn with the same points.
SEED = 20231


def thin(n_points: int, most: int) -> Int64[np.ndarray, "m"] | None:
    """Indices of the points to keep, ascending; None = all.

    The cloud is divided into `most` runs of equal length, and one random point of each is kept. Consecutive points of a
    scan or an image are neighbours, so the cloud is thinned evenly. The time does not depend on the cloud's size.
    """
    if n_points <= most:
        return None
    edges = np.arange(most + 1, dtype=np.int64) * n_points // most
    return edges[:-1] + (_positions(most) * np.diff(edges)).astype(np.int64)


@lru_cache(maxsize=8)
def _positions(most: int) -> Float64[np.ndarray, "m"]:
    """The position of each kept point within its run, 0..1."""
    return np.random.default_rng(SEED).random(most)
