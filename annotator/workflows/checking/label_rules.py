"""Rules about labels, which datasets and projects share, and rules about one frame of a dataset.

The shared ones are about the geometry of boxes, and values of attributes; each yields the index of an offending box in
its list, with a message. Those of a frame are about its labels, its camera, and whether its cloud fits both.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from jaxtyping import Float64

from annotator.formats.kitti_rows import NEAR_M, KittiLabel, derived_box, label_box, observation_angle
from annotator.geometry.iou import iou_3d_matrix
from annotator.geometry.oriented_box import box_corners, contains, turn_of_heading
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import every_nth, project
from annotator.project.classes.attributes import Attribute, AttributeOf, value_text
from annotator.recordings.plausible import DISTANCES_M
from annotator.types import Camera, Frame, Label, OrientedBox, Truth
from annotator.types.label import AttributeValue
from annotator.types.messages import amount
from annotator.workflows.checking import findings as rules
from annotator.workflows.checking.findings import Rule
from annotator.workflows.recorded.reading import FoundLabel

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
# The same between boxes of a track that are several frames apart; what the page marks. As in web_assets/js/box3d.js.
FAR_JUMP_RAD = float(np.deg2rad(120))
OVERLAP_IOU = 0.3
LEAST_POINTS = 5

Boxes = Sequence[Truth]
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
    usual: dict[str, UsualSize] = {}
    for name, every in by_class.items():
        if len(every) >= LEAST_FOR_MEDIAN:
            sides, median = np.array(every), np.median(every, axis=0)
            deviation = DEVIATION_OF_MAD * np.median(np.abs(np.log(sides / median)), axis=0)
            usual[name] = UsualSize(median, np.maximum(least_factor, np.exp(SIZE_DEVIATIONS * deviation)))
    return usual


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


def heading_jumps(
    boxes: Boxes, earlier: Boxes, *, tracked_only: bool = False, last: Mapping[int, Truth] | None = None
) -> Iterator[BoxBreach]:
    """Yields boxes that have turned by more than `HEADING_JUMP_RAD` since the previous frame.

    Args:
        earlier: the boxes of the previous frame. A box is matched by its track id, else with the nearest box of its
            class within its own length.
        tracked_only: match by track id only, for frames that may not be consecutive in time.
        last: the last boxes of tracks by their ids. A box without a match is compared with that of its track, and may
            have turned by `FAR_JUMP_RAD`.
    """
    for number, each in enumerate(boxes):
        other, most_rad, since = _predecessor(each, earlier, tracked_only), HEADING_JUMP_RAD, "the previous frame"
        if other is None and last is not None and each.track_id is not None:
            other, most_rad, since = last.get(each.track_id), FAR_JUMP_RAD, f"the last box of track {each.track_id}"
        if other is None:
            continue
        angle = turn_of_heading(each.box, other.box)
        if angle > most_rad:
            yield number, f"{each.label} has turned by {np.rad2deg(angle):.0f} degrees since {since}"


# An object moves if it goes this far in so many steps, longest sides; it goes backwards if each of these does.
MOVES, MOVING_STEPS = 0.5, 3
# A step is a jump if it is longer than this, longest sides, and than this multiple of the median of those around it.
JUMP, TIMES_USUAL, AROUND = 1.0, 4.0, 4


def moves_backwards(boxes: Sequence[OrientedBox]) -> Iterator[tuple[int, float]]:
    """Yields where a track begins to move against its heading, and how far it does, metres.

    Args:
        boxes: in order of time, in a world that stands still.
    """
    steps = np.diff([box.center_m for box in boxes], axis=0)
    is_against = [bool(step @ box.rotation[:, 0] < 0) for step, box in zip(steps, boxes, strict=False)]
    start = 0
    for against, run in groupby(is_against):
        end = start + len(list(run))
        far_m = float(np.linalg.norm(boxes[end].center_m - boxes[start].center_m))
        if against and end - start >= MOVING_STEPS and far_m > MOVES * boxes[start].size_m.max():
            yield start, far_m
        start = end


def jumps(boxes: Sequence[OrientedBox], places: Sequence[int]) -> Iterator[tuple[int, float]]:
    """Yields which boxes of a track are too far from the one before, and how far, metres; as `moves_backwards`.

    Args:
        places: the numbers of their frames.
    """
    steps_m = np.linalg.norm(np.diff([box.center_m for box in boxes], axis=0), axis=1)
    each_m = steps_m / np.maximum(np.diff(places), 1)
    for at, (step_m, longest_m) in enumerate(zip(each_m, (box.size_m.max() for box in boxes), strict=False)):
        others = np.r_[each_m[max(at - AROUND, 0) : at], each_m[at + 1 : at + 1 + AROUND]]
        if len(others) >= 2 and step_m > max(JUMP * longest_m, TIMES_USUAL * np.median(others)):
            yield at + 1, float(steps_m[at])


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


def _predecessor(each: Truth, earlier: Boxes, tracked_only: bool) -> Truth | None:
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


SHORTEST_M, LONGEST_M = 0.005, 60.0
FARTHEST_M = 1e4
SAME_OBJECT_IOU, SAME_PLACE_IOU = 0.7, 0.9
LEAST_IMAGE_IOU = 0.4
MOST_ALPHA_OFF_RAD = 0.3
UNKNOWN_ALPHA = -10.0
TRUNCATED = (-1.0, 2.0)
OCCLUDED = range(-1, 4)
# Minimum side of a projected box; a thinner one counts as outside the image.
LEAST_SEEN_PX = 1e-3

Breach = tuple[Rule, int, str]
"""A rule, the index of the label in its list, and a message."""


def rules_of_labels(labels: Sequence[FoundLabel]) -> Iterator[Breach]:
    for number, entry in enumerate(labels):
        size_m = entry.truth.box.size_m
        if size_m.min() < SHORTEST_M or size_m.max() > LONGEST_M:
            yield rules.IMPOSSIBLE_SIZE, number, size_message(entry.truth.label, size_m)
        if np.abs(entry.truth.box.center_m).max() > FARTHEST_M:
            yield rules.IMPOSSIBLE_PLACE, number, f"the centre of this {entry.truth.label} is more than 10 km away"
        if entry.row is not None:
            for rule, message in _row_rules(entry.row):
                yield rule, number, message


def is_plausible(entry: FoundLabel) -> bool:
    """False for a box that is too large or too far away for further computations."""
    box = entry.truth.box
    return bool(np.abs(box.center_m).max() <= FARTHEST_M and box.size_m.max() <= FARTHEST_M)


def rules_among_labels(labels: Sequence[FoundLabel]) -> Iterator[Breach]:
    """Checks for duplicate boxes and track ids."""
    truths = [entry.truth for entry in labels]
    for first, second, iou in overlaps(truths, OVERLAP_IOU):
        a, b = truths[first].label, truths[second].label
        other = f"{a} of line {labels[first].line}" if labels[first].line else f"earlier {a}"
        message = f"overlaps the {other} by {iou:.0%} (exact 3D IoU)"
        if iou >= (SAME_OBJECT_IOU if a == b else SAME_PLACE_IOU):
            yield rules.DUPLICATE_LABEL, second, f"this {b} {message}; keep one of them"
        elif a == b:
            yield rules.BOX_OVERLAP, second, f"this {b} {message}"
    seen: set[int] = set()
    for number, truth in enumerate(truths):
        if truth.track_id is not None and truth.track_id in seen:
            yield rules.TRACK_TWICE, number, f"two objects of this frame have the track id {truth.track_id}"
        seen.update(() if truth.track_id is None else (truth.track_id,))


def _row_rules(row: KittiLabel) -> Iterator[tuple[Rule, str]]:
    if not TRUNCATED[0] <= row.truncated <= TRUNCATED[1]:
        yield rules.FIELD_RANGE, f"truncated is {row.truncated:g}; it must be a fraction, 0 to 1 (tracking: 0, 1 or 2)"
    if row.occluded not in OCCLUDED:
        yield rules.FIELD_RANGE, f"occluded is {row.occluded}; it must be 0, 1, 2 or 3"
    if row.score is not None:
        yield rules.FIELD_RANGE, f"has a 16th field, a score ({row.score:g}), which only detections have; remove it"
    if row.right <= row.left or row.bottom <= row.top:
        edges = f"{row.left:g} {row.top:g} {row.right:g} {row.bottom:g}"
        yield (
            rules.BROKEN_LABEL,
            f"the 2D box is empty: left top right bottom = {edges}; left < right and top < bottom must hold",
        )
    expected = observation_angle(row.rotation_y, row.x, row.z)
    off = math.remainder(row.alpha - expected, 2 * math.pi)
    if row.alpha != UNKNOWN_ALPHA and abs(off) > MOST_ALPHA_OFF_RAD:
        yield (
            rules.ALPHA_OFF,
            f"alpha is {row.alpha:g}; rotation_y {row.rotation_y:g} and the position give {expected:.2f}",
        )


def rules_in_frame(frame: Frame, labels: Sequence[FoundLabel]) -> Iterator[Breach]:
    # if the cloud has points behind the camera, boxes outside the image are valid
    all_around = bool((frame.cloud.xyz_m[:, 2] <= 0).any())
    for number, entry in enumerate(labels):
        truth = entry.truth
        if not all_around:
            if (box_corners(truth.box)[:, 2] <= NEAR_M).all():
                yield rules.BOX_BEHIND_CAMERA, number, f"this {truth.label} is behind the camera"
                continue
            if box_on_image(frame.camera, truth.box, truth.label, LEAST_SEEN_PX) is None:
                yield rules.BOX_OUTSIDE_IMAGE, number, f"this {truth.label} is outside the image"
                continue
        count = int(np.count_nonzero(contains(truth.box, frame.cloud.xyz_m)))
        if count < LEAST_POINTS:
            yield rules.EMPTY_BOX if count == 0 else rules.SPARSE_BOX, number, few_points_message(truth.label, count)
        if entry.row is not None:
            for rule, message in _image_box(frame, entry.row):
                yield rule, number, message


def _image_box(frame: Frame, row: KittiLabel) -> Iterator[tuple[Rule, str]]:
    derived = derived_box(frame.camera, label_box(row), frame.T_camera_label)
    labelled = np.array([row.left, row.top, row.right, row.bottom])
    if derived is None or (labelled[2:] <= labelled[:2]).any():
        return
    projected = np.array(derived.clipped)
    iou = _iou(labelled, projected)
    if iou < LEAST_IMAGE_IOU:
        edges = " ".join(f"{edge:.0f}" for edge in projected)
        yield (
            rules.IMAGE_BOX_OFF,
            f"the 2D box of this {row.label} does not match the projection of its 3D box: {edges} (IoU {iou:.2f})",
        )


def _iou(a: np.ndarray, b: np.ndarray) -> float:
    """Returns the IoU of two boxes on an image, left top right bottom."""
    shared = np.prod(np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None))
    union = np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - shared
    return float(shared / union) if union > 0 else 0.0


# Focal length in image widths: fields of view from 150 to 2 degrees.
FOCAL_LENGTHS = (0.13, 30.0)
# Ratio of the focal lengths: pixels are square, or binned in one direction.
MOST_ASPECT = 2.0
# Range of the principal point as a fraction of the image size; cropped images have it far from the middle.
PRINCIPAL_POINT = (0.2, 0.8)
SAMPLE = 5000
MOST_OFF_PIXEL_PX = 1.0
# Nearly all points of a depth camera are on its image, except at the border.
LEAST_ON_IMAGE, BORDER_PX = 0.9, 3.0
CELL_PX = 16
LEAST_COVERED = 0.02

CameraBreach = tuple[Rule, str]


def camera_rules(camera: Camera) -> Iterator[CameraBreach]:
    """Yields what is implausible about a camera for its image size."""
    size = f"for images of {camera.width_px} x {camera.height_px} px"
    shares = camera.fx / camera.width_px, camera.fy / camera.width_px
    low, high = FOCAL_LENGTHS
    aspect = max(shares) / min(shares)
    if min(shares) < low or max(shares) > high or aspect > MOST_ASPECT:
        yield rules.IMPOSSIBLE_CAMERA, f"focal lengths {camera.fx:g} and {camera.fy:g} px {size}"
    middle = np.array([camera.cx / camera.width_px, camera.cy / camera.height_px])
    if (middle < PRINCIPAL_POINT[0]).any() or (middle > PRINCIPAL_POINT[1]).any():
        yield (
            rules.CAMERA_OF_OTHER_SIZE,
            f"the principal point is ({camera.cx:g}, {camera.cy:g}) {size}; is it the camera of another image size?",
        )


def cloud_rules(frame: Frame, *, of_depth_camera: bool) -> Iterator[CameraBreach]:
    """Yields what is implausible about a frame's cloud.

    Args:
        of_depth_camera: all points come from pixels of the image.
    """
    xyz_m = frame.cloud.xyz_m
    distance_m = float(np.median(np.linalg.norm(xyz_m, axis=1)))
    if not DISTANCES_M[0] <= distance_m <= DISTANCES_M[1]:
        yield rules.CLOUD_SCALE, f"half of the points are nearer than {distance_m:g} m; are they in metres?"
    chosen = every_nth(np.arange(len(xyz_m)), SAMPLE)
    px = project(frame.camera, xyz_m[chosen])
    if frame.cloud.pixel_index is not None:
        v, u = np.divmod(frame.cloud.pixel_index[chosen], frame.camera.width_px)
        off = np.linalg.norm(px - np.stack([u, v], axis=1), axis=1)
        typical = float(np.median(np.nan_to_num(off, nan=np.inf)))
        if typical > MOST_OFF_PIXEL_PX:
            yield rules.CLOUD_OFF_DEPTH, f"points project {typical:.1f} px away from their own pixels"
    size = np.array([frame.camera.width_px, frame.camera.height_px])
    # points behind the camera are NaN and compare as false
    on_image = ((px >= -BORDER_PX) & (px <= size + BORDER_PX)).all(axis=1)
    if of_depth_camera and on_image.mean() < LEAST_ON_IMAGE:
        yield (
            rules.CLOUD_OFF_IMAGE,
            f"{1 - on_image.mean():.0%} of this depth camera's points are outside its image",
        )
    elif frame.depth_m is None:
        cells = np.unique(np.floor(px[on_image] / CELL_PX).clip(0).astype(np.int64), axis=0)
        covered = len(cells) / np.prod(np.ceil(size / CELL_PX))
        if covered < LEAST_COVERED:
            yield (
                rules.IMAGE_BARE,
                f"the points cover {covered:.1%} of the image; is the calibration that of the cloud?",
            )
