"""The expected error of a detected edge, from the spread that the network predicts for it.

The spread (`backends/edge_spread.py`) is the width of a distribution, not an error. How large an error goes with it is
fitted on images that the network was not trained on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from annotator.detection.config import EdgeErrors

# A fit needs at least this many edges, and must explain the errors better than one constant by this log-likelihood.
MIN_EDGES, MIN_GAIN = 200, 0.02
MIN_EXPONENT = 0.1
# Spreads beyond these percentiles are treated as these, percent.
SEEN_SPREADS = (2.0, 98.0)
# Errors above this multiple of the expected one are treated as that: the detection is of another object.
MOST_ERRORS = 6.0
# Smallest spread and error that are told apart, pixels.
LEAST_PX = 0.01
# Newton's steps of a fit, and fits, each with the outliers of the last one.
STEPS, FITS = 50, 4


# Gives out the spreads as they are.
SPREAD_ITSELF = EdgeErrors(factor=1.0, exponent=1.0, least_px=LEAST_PX, most_px=1e6)


@dataclass(frozen=True)
class Refused:
    """Why a fit of `EdgeErrors` cannot be used."""

    reason: str


def fit_edge_errors(spread_px: Float64[np.ndarray, "n"], error_px: Float64[np.ndarray, "n"]) -> EdgeErrors | Refused:
    """The map under which the errors are most likely, if they have a Laplace distribution.

    Args:
        spread_px, error_px: of edges on images that the network was not trained on; errors may have a sign.
    """
    if len(spread_px) < MIN_EDGES:
        return Refused(f"{len(spread_px)} edges to fit to; needs {MIN_EDGES}")
    least, most = (max(value, LEAST_PX) for value in np.percentile(spread_px, SEEN_SPREADS).tolist())
    size = np.abs(error_px) + LEAST_PX
    logs = np.log(np.clip(spread_px, least, most))
    rows = np.stack([np.ones_like(logs), logs], axis=1)
    expected = np.full(len(size), np.median(size) / np.log(2))
    for _ in range(FITS):
        within = np.minimum(size, MOST_ERRORS * expected)
        unknowns = _most_likely(rows, within)
        expected = np.exp(rows @ unknowns)
    gain = float((np.log(within.mean()) + 1) - (np.log(expected) + within / expected).mean())
    if unknowns[1] < MIN_EXPONENT or gain < MIN_GAIN:
        return Refused(f"the spread hardly tells the error (exponent {unknowns[1]:.2f}, gain {gain:.3f})")
    return EdgeErrors(
        factor=float(np.exp(unknowns[0])),
        exponent=float(unknowns[1]),
        least_px=least,
        most_px=most,
        edges=len(spread_px),
        gain=gain,
    )


def _most_likely(rows: Float64[np.ndarray, "n 2"], size: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "2"]:
    """The logarithm of the expected error as a linear function of the rows, for errors with a Laplace distribution."""
    unknowns = np.array([np.log(size.mean()), 0.0])
    for _ in range(STEPS):
        # minus the log-likelihood, sum(log b + size / b) with b = exp(rows @ unknowns), is convex: Newton's steps
        ratio = size * np.exp(-rows @ unknowns)
        curvature = rows.T @ (rows * ratio[:, None]) + 1e-9 * len(rows) * np.eye(2)
        step = np.linalg.solve(curvature, rows.T @ (ratio - 1))
        unknowns = unknowns + np.clip(step, -1.0, 1.0)
        if np.abs(step).max() < 1e-9:
            break
    return unknowns
