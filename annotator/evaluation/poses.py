"""How far a box is from the true one: centre, size, and rotation modulo what a box cannot tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from annotator.evaluation.boxes import BoxTable

# Two ways to name the axes of a box fit the true one equally well if its lengths then are off by no more than this
# factor from what the better way gives: a square footprint looks the same after a quarter turn.
SAME_LENGTHS = 1.1

# The 24 ways to name the axes of a box: which of its own axes, with which sign, becomes x, y, z.
NAMINGS = np.rint(Rotation.create_group("O").as_matrix())
NAMINGS.flags.writeable = False


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Of n pairs of a box and a true one.

    Attributes:
        center_m: distance of the centres.
        rotation_rad: the smallest turn that brings the axes in line, 0..pi.
        size: mean of |length - true length| / true length over the three axes.
    """

    center_m: Float64[np.ndarray, "n"]
    rotation_rad: Float64[np.ndarray, "n"]
    size: Float64[np.ndarray, "n"]


def pose_errors(boxes: BoxTable, truth: BoxTable) -> PoseErrors:
    """Compares the i-th box with the i-th true one.

    A box is the same box under 24 names: length, width and height may change places with the axes. Of the names under
    which its lengths fit the true ones best (within `SAME_LENGTHS`) the one with the smallest turn counts. So front
    and back are never told apart, length and width only where they differ.
    """
    every = np.arange(len(boxes))
    sizes = np.abs(NAMINGS).transpose(0, 2, 1)[:, None] @ boxes.size[None, :, :, None]
    share = sizes[..., 0] / truth.size
    misfit = np.abs(np.log(share)).max(axis=2)
    allowed = misfit <= misfit.min(axis=0) + np.log(SAME_LENGTHS)
    turned = np.swapaxes(truth.rotation, 1, 2) @ boxes.rotation @ NAMINGS[:, None]
    # exact near 0, where the trace says nothing
    chord = np.linalg.norm(turned - np.eye(3), axis=(2, 3)) / np.sqrt(8.0)
    angle = np.where(allowed, 2.0 * np.arcsin(np.minimum(chord, 1.0)), np.inf)
    # of equal turns the best lengths
    best = np.lexsort((misfit, np.round(angle, 9)), axis=0)[0]
    return PoseErrors(
        np.linalg.norm(boxes.center - truth.center, axis=1),
        angle[best, every],
        np.abs(share[best, every] - 1.0).mean(axis=1),
    )
