"""Rules about one frame of a dataset: its labels, its camera, and whether its cloud fits both."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from annotator.formats.kitti_rows import NEAR_M, KittiLabel, derived_box, label_box, observation_angle
from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import every_nth, project
from annotator.recordings.plausible import DISTANCES_M
from annotator.types import Camera, Frame
from annotator.workflows.checking import findings as rules
from annotator.workflows.checking.box_rules import LEAST_POINTS, OVERLAP_IOU, few_points_message, overlaps, size_message
from annotator.workflows.checking.findings import Rule
from annotator.workflows.recorded.reading import FoundLabel

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
    """Checks each label on its own."""
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
    """Checks the boxes against the image and the cloud."""
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
