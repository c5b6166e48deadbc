"""Rules about labels that datasets and projects share: the geometry of boxes, and values of attributes.

Each rule yields the index of an offending box in its list, with a message.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from annotator.geometry.iou import iou_3d_matrix
from annotator.project.classes.attributes import Attribute, AttributeOf, value_text
from annotator.types import Label, Truth
from annotator.types.label import AttributeValue
from annotator.types.messages import amount

# Factor by which a side may differ from the median of its class.
SIZE_FACTOR = 1.6
# The same within one track.
TRACK_SIZE_FACTOR = 1.35
# A class with varying sizes is allowed this many of its own standard deviations.
SIZE_DEVIATIONS = 5.0
# Median absolute deviation to standard deviation, for a normal distribution.
DEVIATION_OF_MAD = 1.4826
LEAST_FOR_MEDIAN = 5
HEADING_JUMP_RAD = float(np.deg2rad(60))
OVERLAP_IOU = 0.3
LEAST_POINTS = 5

Boxes = Sequence[Label | Truth]
BoxBreach = tuple[int, str]
"""The index of a box in its list, and a message."""


@dataclass(frozen=True, eq=False)
class UsualSize:
    """The usual size of the boxes of a class or track.

    Attributes:
        median_m: longer and shorter side on the ground, height.
        factor: factor by which each of them may differ.
    """

    median_m: Float64[np.ndarray, "3"]
    factor: Float64[np.ndarray, "3"]

    def odd(self, size_m: Float64[np.ndarray, "3"]) -> bool:
        """True for a size that differs by more than `factor`; length and width may be swapped."""
        return bool((np.abs(np.log(_sides(size_m) / self.median_m)) > np.log(self.factor)).any())


def usual_sizes(
    sizes: Iterable[tuple[str, Float64[np.ndarray, "3"]]], least_factor: float = SIZE_FACTOR
) -> dict[str, UsualSize]:
    """Returns the usual size of each class (or track) with at least `LEAST_FOR_MEDIAN` boxes.

    A class with varying sizes, such as tables, is allowed `SIZE_DEVIATIONS` of its own standard deviations.
    """
    by_class: dict[str, list[np.ndarray]] = defaultdict(list)
    for name, size_m in sizes:
        by_class[name].append(_sides(size_m))
    enough = {name: np.array(sides) for name, sides in by_class.items() if len(sides) >= LEAST_FOR_MEDIAN}
    return {name: _usual(sides, least_factor) for name, sides in enough.items()}


def _usual(sides: Float64[np.ndarray, "n 3"], least_factor: float) -> UsualSize:
    median = np.median(sides, axis=0)
    deviation = DEVIATION_OF_MAD * np.median(np.abs(np.log(sides / median)), axis=0)
    return UsualSize(median, np.maximum(least_factor, np.exp(SIZE_DEVIATIONS * deviation)))


def odd_sizes(boxes: Boxes, usual: Mapping[str, UsualSize]) -> Iterator[BoxBreach]:
    """Yields boxes whose size is far from the usual size of their class."""
    for number, each in enumerate(boxes):
        of_class = usual.get(each.label)
        if of_class is not None and of_class.odd(each.box.size_m):
            yield number, odd_size_message(each.label, each.box.size_m, of_class)


def odd_size_message(label: str, size_m: Float64[np.ndarray, "3"], usual: UsualSize) -> str:
    longer, shorter, height = usual.median_m
    # side by side with those of the box, which may be wider than long
    median_m = (longer, shorter, height) if size_m[0] >= size_m[1] else (shorter, longer, height)
    return f"{size_message(label, size_m)}; the median is {_size_text(median_m)}"


def size_message(label: str, size_m: Float64[np.ndarray, "3"]) -> str:
    return f"{label} of {_size_text(size_m)} (length x width x height)"


def _size_text(size_m: Iterable[float]) -> str:
    return " x ".join(f"{side:.2f}" for side in size_m) + " m"


def heading_jumps(boxes: Boxes, earlier: Boxes, *, tracked_only: bool = False) -> Iterator[BoxBreach]:
    """Yields boxes that have turned by more than `HEADING_JUMP_RAD` since the previous frame.

    Args:
        earlier: the boxes of the previous frame. A box is matched by its track id, else with the nearest box of its
            class within its own length.
        tracked_only: match by track id only, for frames that may not be consecutive in time.
    """
    for number, each in enumerate(boxes):
        other = _predecessor(each, earlier, tracked_only)
        if other is None:
            continue
        cosine = float(np.clip(each.box.rotation[:, 0] @ other.box.rotation[:, 0], -1, 1))
        angle = float(np.arccos(cosine))
        if angle > HEADING_JUMP_RAD:
            yield number, f"{each.label} has turned by {np.rad2deg(angle):.0f} degrees since the previous frame"


def overlaps(boxes: Boxes, least_iou: float) -> Iterator[tuple[int, int, float]]:
    """Yields the pairs of boxes with an exact 3D IoU of at least `least_iou`, and the IoU; lower index first."""
    parts = [each.box for each in boxes]
    matrix = np.triu(iou_3d_matrix(parts, parts), 1) if len(parts) > 1 else np.zeros((0, 0))
    for first, second in np.argwhere(matrix >= least_iou).tolist():
        yield first, second, float(matrix[first, second])


def few_points_message(label: str, count: int) -> str:
    """Returns the message for a box with fewer than `LEAST_POINTS` points."""
    return f"the box of this {label} holds {amount(count, 'point')}"


def _sides(size_m: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    return np.array([size_m[:2].max(), size_m[:2].min(), size_m[2]])


def _predecessor(each: Label | Truth, earlier: Boxes, tracked_only: bool) -> Label | Truth | None:
    same = [other for other in earlier if other.label == each.label]
    if each.track_id is not None:
        tracked = next((other for other in same if other.track_id == each.track_id), None)
        if tracked is not None:
            return tracked
    if tracked_only:
        return None
    reach = float(each.box.size_m.max())
    near = [(float(np.linalg.norm(other.box.center_m - each.box.center_m)), n) for n, other in enumerate(same)]
    if not near or min(near)[0] > reach:
        return None
    nearest = same[min(near)[1]]
    # different track ids mean different objects
    return nearest if nearest.track_id is None or each.track_id is None else None


def odd_values(labels: Sequence[Label], attributes: Sequence[Attribute]) -> Iterator[tuple[int, str]]:
    """Yields the index of a label and a message for values that are missing, do not fit, or have no attribute."""
    for number, label in enumerate(labels):
        of_label = {each.name: each for each in attributes if each.is_of(label.label)}
        for each in of_label.values():
            if each.required and each.name not in label.attributes:
                yield number, _missing(each, label.label)
        for name, value in label.attributes.items():
            if name not in of_label:
                yield number, _unknown(name, value, f"this {label.label}", label.label)
            elif not of_label[name].fits(value):
                yield number, f"{name} is {value_text(value)}; it must be {of_label[name].values_text()}"


def odd_frame_values(
    values: Mapping[str, AttributeValue], attributes: Sequence[Attribute], is_complete: bool
) -> Iterator[str]:
    """Yields messages about the values of a frame.

    Args:
        is_complete: whether required values must be there; a default is enough.
    """
    of_frames = {each.name: each for each in attributes if each.of is AttributeOf.FRAME}
    for each in of_frames.values() if is_complete else ():
        if each.required and each.default is None and each.name not in values:
            yield _missing(each, "frame")
    for name, value in values.items():
        if name not in of_frames:
            yield _unknown(name, value, "this frame", "frames")
        elif not of_frames[name].fits(value):
            yield f"{name} of this frame is {value_text(value)}; it must be {of_frames[name].values_text()}"


def _missing(attribute: Attribute, what: str) -> str:
    return f"this {what} has no value of {attribute.name}, which is required"


def _unknown(name: str, value: AttributeValue, this: str, owners: str) -> str:
    return f"{this} has the value {name} = {value_text(value)}, but the project has no attribute {name} for {owners}"
