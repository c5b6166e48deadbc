"""Smoothing of one object's boxes over time: a common size, and a rotation without jumps.

Detectors cannot distinguish a box's front from its back, and the axes of a free box can be labelled in 24 ways. So the
axes of each box are first relabelled to match its neighbours in time. Then the labelling of the whole track is chosen:
that of the reviewed boxes, or, without reviewed boxes, that of the majority. In the second case, front and back
of upright boxes that move backwards are swapped. The motion is only used if the camera is static.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial.transform import Rotation, Slerp

from annotator.types import OrientedBox
from annotator.types.errors import GeometryError

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


# Half a turn about z: swaps front and back.
FLIP = np.diag([-1.0, -1.0, 1.0])
# Maximum difference of the logarithms of equal lengths.
SAME_LENGTH = 1e-6
# Boxes within this many frames before and after a box smooth its rotation.
WINDOW = 2.0
# If the mean squared successive difference of a side's lengths is below this multiple of their variance (2 for
# independent values), the side varies in time and gets no common length; minimum number of boxes for this test.
CHANGE_RATIO, LEAST_FOR_CHANGE = 0.7, 5
# Weight of a reviewed box; a proposal has 1.
REVIEWED_WEIGHT = 4.0
# Minimum distance travelled, in longest sides, for the motion to tell the front; minimum mean cosine between motion
# and length axis to count as moving forward or backward.
LEAST_MOTION, LEAST_ALONG = 0.5, 0.7
# Maximum difference between rotations that are averaged, radians.
ANOTHER_RAD = float(np.deg2rad(60))


@dataclass(frozen=True, eq=False)
class TrackBox:
    """One box of an object.

    Attributes:
        time: time of its frame, from `frame_times`.
        box: camera frame.
        weight: above 0.
        is_fixed: a reviewed box, which is not changed and determines the labelling of the others.
    """

    time: float
    box: OrientedBox
    weight: float = 1.0
    is_fixed: bool = False


def smoothed(track: Sequence[TrackBox], is_still: bool = True) -> list[OrientedBox]:
    """The boxes of one object with a common size and smooth rotations; the centres stay as they are.

    Args:
        track: at least one box, in order of time.
        is_still: whether the camera is static, so that all motion is the object's.

    Returns:
        one box for each box of the track; fixed boxes are returned unchanged.
    """
    alike = _relabelled_alike(track, is_still)
    times = np.array([each.time for each in track])
    weights = np.array([each.weight * (REVIEWED_WEIGHT if each.is_fixed else 1.0) for each in track])
    sizes_m = _smooth_sizes(times, weights, np.array([box.size_m for box in alike]))
    rotations = _smooth_rotations(times, weights, alike)
    return [
        each.box if each.is_fixed else OrientedBox.from_parts(each.box.center_m, rotation.as_matrix(), size_m)
        for each, rotation, size_m in zip(track, rotations, sizes_m, strict=True)
    ]


def _relabelled_alike(track: Sequence[TrackBox], is_still: bool) -> list[OrientedBox]:
    """All boxes with their axes relabelled consistently, by the labelling of the whole track."""
    boxes = [each.box for each in track]
    is_upright = are_upright(boxes)
    changes = relabellings(is_upright)
    # start from a reviewed box if there is one, since its labelling is correct
    start = max(range(len(track)), key=lambda place: (track[place].is_fixed, -place))
    applied = {start: changes[0]}
    for order in (range(start + 1, len(track)), range(start - 1, -1, -1)):
        reference = boxes[start]
        for place in order:
            applied[place] = changes[0] if track[place].is_fixed else nearest_change(boxes[place], reference, changes)
            reference = relabelled(boxes[place], applied[place])
    alike = [relabelled(box, applied[place]) for place, box in enumerate(boxes)]
    if track[start].is_fixed:
        return alike
    common = _common_change(track, [applied[place] for place in range(len(track))], changes)
    alike = [relabelled(box, common) for box in alike]
    if is_upright and is_still and _moves_backward(alike):
        alike = [relabelled(box, FLIP) for box in alike]
    return alike


def _common_change(
    track: Sequence[TrackBox], applied: Sequence[Float64[np.ndarray, "3 3"]], changes: Float64[np.ndarray, "k 3 3"]
) -> Float64[np.ndarray, "3 3"]:
    """The relabelling that restores the original labelling of most boxes, by weight, after the changes in `applied`."""
    restored = [
        sum(
            each.weight
            for each, change in zip(track, applied, strict=True)
            if np.array_equal(change @ common, np.eye(3))
        )
        for common in changes
    ]
    best: Float64[np.ndarray, "3 3"] = changes[int(np.argmax(restored))]
    return best


def _moves_backward(boxes: Sequence[OrientedBox]) -> bool:
    """True if upright boxes move along their length axis, backwards."""
    steps = np.diff([box.center_m for box in boxes], axis=0)
    path = np.linalg.norm(steps, axis=1)
    distance = float(np.linalg.norm(boxes[-1].center_m - boxes[0].center_m))
    if distance < LEAST_MOTION * max(box.size_m.max() for box in boxes):
        return False
    headings = np.array([box.rotation[:, 0] for box in boxes])
    along = np.einsum("ij,ij->", steps, (headings[:-1] + headings[1:]) / 2) / path.sum()
    return bool(along < -LEAST_ALONG)


def _smooth_sizes(
    times: Float64[np.ndarray, "n"],
    weights: Float64[np.ndarray, "n"],
    sizes_m: Float64[np.ndarray, "n 3"],
) -> Float64[np.ndarray, "n 3"]:
    """The weighted median of each side over the track, or over a window if the side varies in time."""
    smooth = np.tile(_median(sizes_m, weights), (len(sizes_m), 1))
    for side in range(3):
        if _changes_in_time(sizes_m[:, side]):
            around = (_around(times, place) for place in range(len(times)))
            smooth[:, side] = [_median(sizes_m[near, side], weights[near]) for near in around]
    return smooth


def _median(values: Float64[np.ndarray, "n *more"], weights: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "*more"]:
    return np.asarray(np.quantile(values, 0.5, axis=0, method="inverted_cdf", weights=weights))


def _changes_in_time(lengths_m: Float64[np.ndarray, "n"]) -> bool:
    """True for a side that really varies, such as the length of a walking person; False for measurement noise.

    Noise differs between successive lengths as much as between any two. Real variation differs less between successive
    lengths (von Neumann ratio: mean squared successive difference over variance, 2 for independent values).
    """
    logs = np.log(lengths_m)
    if len(logs) < LEAST_FOR_CHANGE or np.ptp(logs) < SAME_LENGTH:
        return False
    return bool(np.mean(np.diff(logs) ** 2) < CHANGE_RATIO * np.var(logs))


def _smooth_rotations(
    times: Float64[np.ndarray, "n"],
    weights: Float64[np.ndarray, "n"],
    boxes: Sequence[OrientedBox],
) -> list[Rotation]:
    """The mean rotation over a window around each box, with Gaussian weights."""
    rotations = Rotation.from_matrix(np.array([box.rotation for box in boxes]))
    smooth = []
    for place, time in enumerate(times):
        near = _around(times, place)
        # reviewed boxes with different labellings cannot be averaged
        near = near[(rotations[near] * rotations[place].inv()).magnitude() < ANOTHER_RAD]
        fading = np.exp(-0.5 * (2 * (times[near] - time) / WINDOW) ** 2)
        smooth.append(rotations[near].mean(weights[near] * fading) if len(near) > 1 else rotations[place])
    return smooth


def _around(times: Float64[np.ndarray, "n"], place: int) -> Int[np.ndarray, "k"]:
    """The indices of a symmetric window around a box; symmetric so that a uniform change is preserved at the ends."""
    reach = min(WINDOW, times[place] - times[0], times[-1] - times[place])
    return np.flatnonzero(np.abs(times - times[place]) <= reach + 1e-9)


def between(
    first: OrientedBox, last: OrientedBox, first_time: float, last_time: float, times: Sequence[float]
) -> list[OrientedBox]:
    """Boxes between two known boxes: centre and size by linear interpolation, the rotation by slerp.

    The axes of the last box are first relabelled to be as similar to the first box as possible. Otherwise, if front and
    back were swapped, the boxes in between would make half a turn.

    Args:
        times: strictly between `first_time` and `last_time`.
    """
    if any(not first_time < time < last_time for time in times):
        raise GeometryError(
            "only frames between the two known boxes can be filled; choose an earlier and a later frame"
        )
    last = relabelled(last, nearest_change(last, first, relabellings(are_upright([first, last]))))
    turn = Slerp([0.0, 1.0], Rotation.concatenate([first.T_camera_box.rotation, last.T_camera_box.rotation]))
    shares = (np.array(times) - first_time) / (last_time - first_time)
    rotations = turn(shares).as_matrix() if len(shares) else ()  # scipy cannot turn nothing
    return [
        OrientedBox.from_parts(
            (1 - share) * first.center_m + share * last.center_m,
            rotation,
            (1 - share) * first.size_m + share * last.size_m,
        )
        for share, rotation in zip(shares, rotations, strict=True)
    ]
