"""Pose errors of boxes: centre, size, and rotation modulo the symmetries of a box."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from annotator.evaluation.boxes import BoxTable

# Labellings whose size misfit is within this factor of the best one are equivalent: a nearly square footprint looks the
# same after a quarter turn.
SAME_LENGTHS = 1.1

# The 24 labellings of a box's axes: which axis, with which sign, becomes x, y, z.
LABELLINGS = np.rint(Rotation.create_group("O").as_matrix())
LABELLINGS.flags.writeable = False


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """The errors of n pairs of a detection and a true box.

    Attributes:
        center_m: distance of the centres.
        rotation_rad: the smallest rotation that aligns the axes, 0..pi.
        size: mean of |length - true length| / true length over the three axes.
    """

    center_m: Float64[np.ndarray, "n"]
    rotation_rad: Float64[np.ndarray, "n"]
    size: Float64[np.ndarray, "n"]


def pose_errors(boxes: BoxTable, truth: BoxTable) -> PoseErrors:
    """Compares the i-th box with the i-th true box.

    24 labellings of the axes describe the same box. Among the labellings whose sizes fit the true ones best
    (within `SAME_LENGTHS`), the one with the smallest rotation counts. So front and back are equivalent, and length and
    width are equivalent if they are similar.
    """
    every = np.arange(len(boxes))
    sizes = np.abs(LABELLINGS).transpose(0, 2, 1)[:, None] @ boxes.size[None, :, :, None]
    share = sizes[..., 0] / truth.size
    misfit = np.abs(np.log(share)).max(axis=2)
    allowed = misfit <= misfit.min(axis=0) + np.log(SAME_LENGTHS)
    turned = np.swapaxes(truth.rotation, 1, 2) @ boxes.rotation @ LABELLINGS[:, None]
    # precise near 0, unlike the arc cosine of the trace
    chord = np.linalg.norm(turned - np.eye(3), axis=(2, 3)) / np.sqrt(8.0)
    angle = np.where(allowed, 2.0 * np.arcsin(np.minimum(chord, 1.0)), np.inf)
    # for equal rotations, the best sizes
    best = np.lexsort((misfit, np.round(angle, 9)), axis=0)[0]
    return PoseErrors(
        np.linalg.norm(boxes.center - truth.center, axis=1),
        angle[best, every],
        np.abs(share[best, every] - 1.0).mean(axis=1),
    )
