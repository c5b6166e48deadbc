"""One object's boxes over time: one size, and a heading that does not jump.

Detectors cannot tell a box's front from its back, and free boxes have 24 names for their axes. So the axes of each box
are first renamed to be like those of its neighbours in time. What the names of the whole track are is then said by the
boxes that a person has reviewed, else by the motion of upright boxes, which mostly move forward, else by the majority.
What a camera that moves by itself sees of an object's motion says nothing about the object's front.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial.transform import Rotation

from annotator.tracking.config import TrackingConfig
from annotator.tracking.relabel import are_upright, nearest_change, relabelled, relabellings
from annotator.types import OrientedBox

# A turn by half about z: front and back change places.
FLIP = np.diag([-1.0, -1.0, 1.0])
# Logarithms of lengths that differ by less are the same length.
SAME_LENGTH = 1e-6
# Rotations that differ by more have no sensible mean, radians.
ANOTHER_RAD = float(np.deg2rad(60))


@dataclass(frozen=True, eq=False)
class TrackBox:
    """One box of an object.

    Attributes:
        time: of its frame, as `frame_times` gives it.
        box: camera frame.
        weight: how much it counts; above 0.
        is_fixed: a person has reviewed it: it says how the others are, and stays as it is.
    """

    time: float
    box: OrientedBox
    weight: float = 1.0
    is_fixed: bool = False


def smoothed(track: Sequence[TrackBox], config: TrackingConfig, is_still: bool = True) -> list[OrientedBox]:
    """The boxes of one object with the size of all and smooth rotations, their centres as they were.

    Args:
        track: in the order of time, at least one.
        is_still: the camera stands still, so that what moves is the object.

    Returns:
        A box for each; fixed ones are the same objects.
    """
    named = _named_alike(track, config, is_still)
    times = np.array([each.time for each in track])
    weights = np.array([each.weight * (config.reviewed_weight if each.is_fixed else 1.0) for each in track])
    sizes_m = _smooth_sizes(times, weights, np.array([box.size_m for box in named]), config)
    rotations = _smooth_rotations(times, weights, named, config)
    return [
        each.box if each.is_fixed else OrientedBox.from_parts(each.box.center_m, rotation.as_matrix(), size_m)
        for each, rotation, size_m in zip(track, rotations, sizes_m, strict=True)
    ]


def _named_alike(track: Sequence[TrackBox], config: TrackingConfig, is_still: bool) -> list[OrientedBox]:
    """All boxes with axes named as nearly alike as they can be, by the names that the track goes by."""
    boxes = [each.box for each in track]
    is_upright = are_upright(boxes)
    changes = relabellings(is_upright)
    # a reviewed box is named by a person: all others follow from there
    start = max(range(len(track)), key=lambda place: (track[place].is_fixed, -place))
    own = {start: changes[0]}
    for order in (range(start + 1, len(track)), range(start - 1, -1, -1)):
        reference = boxes[start]
        for place in order:
            own[place] = changes[0] if track[place].is_fixed else nearest_change(boxes[place], reference, changes)
            reference = relabelled(boxes[place], own[place])
    alike = [relabelled(box, own[place]) for place, box in enumerate(boxes)]
    if track[start].is_fixed:
        return alike
    common = _common_change(track, [own[place] for place in range(len(track))], changes)
    alike = [relabelled(box, common) for box in alike]
    if is_upright and is_still and _moves_backward(alike, config):
        alike = [relabelled(box, FLIP) for box in alike]
    return alike


def _common_change(
    track: Sequence[TrackBox], own: Sequence[Float64[np.ndarray, "3 3"]], changes: Float64[np.ndarray, "k 3 3"]
) -> Float64[np.ndarray, "3 3"]:
    """What gives most boxes, by weight, their own names back after each was renamed by its change in `own`."""
    kept = [
        sum(each.weight for each, change in zip(track, own, strict=True) if np.array_equal(change @ common, np.eye(3)))
        for common in changes
    ]
    best: Float64[np.ndarray, "3 3"] = changes[int(np.argmax(kept))]
    return best


def _moves_backward(boxes: Sequence[OrientedBox], config: TrackingConfig) -> bool:
    """True where upright boxes move along their length, and against it."""
    steps = np.diff([box.center_m for box in boxes], axis=0)
    path = np.linalg.norm(steps, axis=1)
    way = float(np.linalg.norm(boxes[-1].center_m - boxes[0].center_m))
    if way < config.least_motion * max(box.size_m.max() for box in boxes):
        return False
    headings = np.array([box.rotation[:, 0] for box in boxes])
    along = np.einsum("ij,ij->", steps, (headings[:-1] + headings[1:]) / 2) / path.sum()
    return bool(along < -config.least_along)


def _smooth_sizes(
    times: Float64[np.ndarray, "n"],
    weights: Float64[np.ndarray, "n"],
    sizes_m: Float64[np.ndarray, "n 3"],
    config: TrackingConfig,
) -> Float64[np.ndarray, "n 3"]:
    """The weighted median of each side: over the track, or (a side that changes in time) over the boxes around each."""
    smooth = np.tile(_median(sizes_m, weights), (len(sizes_m), 1))
    for side in range(3):
        if _changes_in_time(sizes_m[:, side], config):
            around = (_around(times, place, config) for place in range(len(times)))
            smooth[:, side] = [_median(sizes_m[near, side], weights[near]) for near in around]
    return smooth


def _median(values: Float64[np.ndarray, "n *more"], weights: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "*more"]:
    return np.asarray(np.quantile(values, 0.5, axis=0, method="inverted_cdf", weights=weights))


def _changes_in_time(lengths_m: Float64[np.ndarray, "n"], config: TrackingConfig) -> bool:
    """True for a side that grows and shrinks, as that of a walking person, and false for one that is measured anew.

    Measured lengths differ from one to the next as much as any two do; lengths that change over time differ less (the
    ratio of von Neumann: mean squared successive difference to variance, 2 for independent values).
    """
    logs = np.log(lengths_m)
    if len(logs) < config.least_for_change or np.ptp(logs) < SAME_LENGTH:
        return False
    return bool(np.mean(np.diff(logs) ** 2) < config.change_ratio * np.var(logs))


def _smooth_rotations(
    times: Float64[np.ndarray, "n"],
    weights: Float64[np.ndarray, "n"],
    named: Sequence[OrientedBox],
    config: TrackingConfig,
) -> list[Rotation]:
    """Of each box the mean rotation of those around it in time, the near ones counting most."""
    rotations = Rotation.from_matrix(np.array([box.rotation for box in named]))
    found = []
    for place, time in enumerate(times):
        near = _around(times, place, config)
        # between boxes that people have named differently there is no middle
        near = near[(rotations[near] * rotations[place].inv()).magnitude() < ANOTHER_RAD]
        fading = np.exp(-0.5 * (2 * (times[near] - time) / max(config.window, 1e-9)) ** 2)
        found.append(rotations[near].mean(weights[near] * fading) if len(near) > 1 else rotations[place])
    return found


def _around(times: Float64[np.ndarray, "n"], place: int, config: TrackingConfig) -> Int[np.ndarray, "k"]:
    """The boxes around one in time: as far before as behind, so that an even change stays as it is, at the ends too."""
    reach = min(config.window, times[place] - times[0], times[-1] - times[place])
    return np.flatnonzero(np.abs(times - times[place]) <= reach + 1e-9)
