"""The rules that a dataset is checked by; `docs/checks.md` has the same table for people.

Ids are stable: programs may rely on them. One rule has one severity.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class Severity(StrEnum):
    """How bad a finding is.

    ERROR: the data cannot be used as they are, or contradict themselves.
    WARNING: looks wrong, a person should look.
    NOTE: worth knowing.
    """

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


class Rule(NamedTuple):
    """A rule: its id, how bad a breach is, and what is found."""

    id: str
    severity: Severity
    meaning: str


RULES: dict[str, Rule] = {}


def _rule(rule_id: str, severity: Severity, meaning: str) -> Rule:
    RULES[rule_id] = Rule(rule_id, severity, meaning)
    return RULES[rule_id]


def _error(rule_id: str, meaning: str) -> Rule:
    return _rule(rule_id, Severity.ERROR, meaning)


def _warning(rule_id: str, meaning: str) -> Rule:
    return _rule(rule_id, Severity.WARNING, meaning)


def _note(rule_id: str, meaning: str) -> Rule:
    return _rule(rule_id, Severity.NOTE, meaning)


# Files
UNREADABLE_DATASET = _error("unreadable-dataset", "a folder looks like a dataset and cannot be opened")
MISSING_FILE = _error("missing-file", "a frame lacks one of its files, such as an image without its cloud")
UNREADABLE_FILE = _error("unreadable-file", "a frame's file is damaged, or has another size than those beside it")
UNREADABLE_CALIBRATION = _error(
    "unreadable-calibration", "a calibration lacks a matrix, or holds no camera or no rotation"
)
UNREADABLE_MASK = _error("unreadable-mask", "a mask is missing, damaged or of another size than its image")
MISSING_LABELS = _error("missing-labels", "a frame has no label file, and others of its dataset have one")
STRAY_FILE = _error(
    "stray-file",
    "labels or a calibration of a frame that is not there, or its name in `ImageSets/`, `*_data_idx.txt`, `splits/`",
)
MANIFEST_MISMATCH = _error("manifest-mismatch", "a dataset's manifest counts other than there is")

UNCHECKED_DATASET = _note(
    "unchecked-dataset",
    "labels that are read, and their boxes not looked at (nuScenes, OpenLABEL, labelCloud, COCO, YOLO)",
)

# Rows
BROKEN_LABEL = _error("broken-label", "a row or entry of a label file is no label")
FIELD_RANGE = _warning(
    "field-range", "a KITTI row's truncated or occluded is none of the format's values, or it has a score"
)
CLASS_SPELLING = _warning("class-spelling", "two class names differ only in case, blanks, `-` or `_`")
TRACK_TWICE = _error("track-twice", "two objects of a frame have one track id")
TRACK_CLASS = _warning("track-class", "a track has changed its class since the frame before")

# Boxes
IMPOSSIBLE_SIZE = _error("impossible-size", "a side of a box is shorter than 5 mm or longer than 60 m")
IMPOSSIBLE_PLACE = _error("impossible-place", "the middle of a box is further than 10 km away")
ODD_SIZE = _warning("odd-size", "a box is far from the median size of its class")
DUPLICATE_LABEL = _error("duplicate-label", "two boxes are one: exact 3D IoU >= 0.7 (>= 0.9 for different classes)")
BOX_OVERLAP = _warning("box-overlap", "two boxes of a class reach into each other: exact 3D IoU >= 0.3")
EMPTY_BOX = _warning("empty-box", "no point of the cloud lies in a box")
SPARSE_BOX = _note("sparse-box", "fewer than 5 points of the cloud lie in a box")
BOX_BEHIND_CAMERA = _error("box-behind-camera", "a box is fully behind the camera")
BOX_OUTSIDE_IMAGE = _error("box-outside-image", "a box is in front of the camera and fully beside the image")
HEADING_JUMP = _warning("heading-jump", "in a sequence a box has turned by more than 60 degrees in one frame")
IMAGE_BOX_OFF = _warning("image-box-off", "KITTI: the labelled 2D box is not where the 3D box projects to (IoU < 0.4)")
ALPHA_OFF = _warning("alpha-off", "KITTI: alpha contradicts rotation_y and the place by more than 0.3 rad")

# Calibration
IMPOSSIBLE_CAMERA = _error("impossible-camera", "focal lengths that no lens has, for images of this size")
CAMERA_OF_OTHER_SIZE = _warning("camera-of-other-size", "the principal point is far from the middle of the image")
CLOUD_SCALE = _warning("cloud-scale", "the points are so near or far that their unit can hardly be metres")
CLOUD_OFF_DEPTH = _error("cloud-off-depth", "points of a depth camera do not project onto their own pixels")
CLOUD_OFF_IMAGE = _error("cloud-off-image", "a depth camera's points fall beside its image in mass")
IMAGE_BARE = _warning("image-bare", "a LiDAR's points cover next to nothing of the image")
BOXES_OFF_CLOUD = _error("boxes-off-cloud", "more than half of a dataset's boxes hold no point")
BOXES_OFF_IMAGE = _error("boxes-off-image", "KITTI: more than half of a dataset's 2D boxes are beside the 3D boxes")
CALIBRATION_OFF = _warning("calibration-off", "edges in depth do not lie on edges of the image (4 frames or more)")
TIME_BACKWARDS = _warning("time-backwards", "in a sequence a frame is not later than the one before")
