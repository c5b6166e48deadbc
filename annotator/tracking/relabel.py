"""Relabelling of box axes: 24 labellings describe the same box; those of a track should be consistent."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from annotator.types import OrientedBox

# Cost of a side ratio of e, relative to a rotation by one radian.
SIZE_COST = 0.5
# Boxes whose z axes differ by less than this, radians, count as upright on the same ground.
SAME_UP_RAD = float(np.deg2rad(15))


@cache
def relabellings(is_upright: bool) -> Float64[np.ndarray, "k 3 3"]:
    """The rotations that relabel a box's axes, the identity first: all 24, or the 4 that keep z."""
    every = np.rint(Rotation.create_group("O").as_matrix())
    chosen = every[every[:, 2, 2] == 1] if is_upright else every
    identity = np.abs(chosen - np.eye(3)).sum(axis=(1, 2))
    return chosen[np.argsort(identity, kind="stable")]


def relabelled(box: OrientedBox, change: Float64[np.ndarray, "3 3"]) -> OrientedBox:
    """The same box with relabelled axes; the columns of `change` are the new axes in terms of the old ones."""
    return OrientedBox.from_parts(box.center_m, box.rotation @ change, np.abs(change).T @ box.size_m)


def nearest_change(
    box: OrientedBox, reference: OrientedBox, changes: Float64[np.ndarray, "k 3 3"]
) -> Float64[np.ndarray, "3 3"]:
    """The relabelling that makes a box most similar to a reference, in rotation and size."""
    rotations = box.rotation @ changes
    cosines = (np.einsum("kij,ij->k", rotations, reference.rotation) - 1) / 2
    sizes = np.abs(changes).transpose(0, 2, 1) @ box.size_m
    cost = np.arccos(np.clip(cosines, -1, 1)) + SIZE_COST * np.abs(np.log(sizes / reference.size_m)).sum(axis=1)
    best: Float64[np.ndarray, "3 3"] = changes[np.argmin(cost)]
    return best


def are_upright(boxes: Sequence[OrientedBox]) -> bool:
    """True if the z axes of all boxes are nearly parallel, as for boxes that stand on the ground."""
    up = np.array([box.rotation[:, 2] for box in boxes])
    middle = up.sum(axis=0)
    length = float(np.linalg.norm(middle))
    return length > 0 and bool((up @ middle >= np.cos(SAME_UP_RAD) * length).all())
