"""The rules of the dataset check, and what one check finds.

`docs/checks.md` has the same table of rules. Ids and severities are stable: programs may rely on them.
"""

from __future__ import annotations

from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import NamedTuple

from annotator.types.bases import Strict
from annotator.types.errors import AnnotatorError


class Severity(StrEnum):
    """The severity of a finding.

    ERROR: the data contradict themselves or cannot be used as they are.
    WARNING: looks wrong; a person should look.
    NOTE: worth knowing.
    """

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


class Rule(NamedTuple):
    """A rule: id, severity of a breach, and what it finds."""

    id: str
    severity: Severity
    meaning: str


RULES: dict[str, Rule] = {}


def _rule(severity: Severity, rule_id: str, meaning: str) -> Rule:
    return RULES.setdefault(rule_id, Rule(rule_id, severity, meaning))


_error, _warning, _note = (partial(_rule, severity) for severity in Severity)

# Files
UNREADABLE_DATASET = _error("unreadable-dataset", "a folder looks like a dataset but cannot be opened")
MISSING_FILE = _error("missing-file", "a frame lacks one of its files, such as an image without its cloud")
UNREADABLE_FILE = _error("unreadable-file", "a frame's file is damaged, or differs in size from those beside it")
UNCLEAR_FILE = _error(
    "unclear-file",
    "how a file is to be read is not certain: the number of values per point in a `.bin`, or SUN RGB-D's depth in "
    "an RGB-D folder",
)
UNREADABLE_CALIBRATION = _error(
    "unreadable-calibration", "a calibration lacks a matrix, or has an invalid camera matrix or rotation"
)
UNREADABLE_MASK = _error("unreadable-mask", "a mask is missing or damaged, or differs in size from its image")
MISSING_LABELS = _error("missing-labels", "a frame has no label file, but others of its dataset have one")
STRAY_FILE = _error(
    "stray-file",
    "a missing frame has labels or a calibration, or is listed in `ImageSets/`, `*_data_idx.txt`, `splits/`",
)
MANIFEST_MISMATCH = _error("manifest-mismatch", "the counts in a dataset's manifest are wrong")

UNCHECKED_DATASET = _note(
    "unchecked-dataset",
    "labels were read, but their boxes not compared with clouds and images (nuScenes, OpenLABEL, labelCloud, "
    "SUSTechPOINTS, COCO, YOLO)",
)

# Rows
BROKEN_LABEL = _error("broken-label", "a row or entry of a label file is not a valid label")
FIELD_RANGE = _warning("field-range", "a KITTI row has an invalid value of truncated or occluded, or a score")
CLASS_SPELLING = _warning("class-spelling", "two class names differ only in case, spaces, `-` or `_`")
TRACK_TWICE = _error("track-twice", "two objects of a frame have the same track id")
TRACK_CLASS = _warning("track-class", "a track has changed its class since the previous frame")

# Boxes
IMPOSSIBLE_SIZE = _error("impossible-size", "a side of a box is shorter than 5 mm or longer than 60 m")
IMPOSSIBLE_PLACE = _error("impossible-place", "the centre of a box is more than 10 km away")
ODD_SIZE = _warning("odd-size", "a box is far from the median size of its class")
DUPLICATE_LABEL = _error(
    "duplicate-label", "two boxes are nearly the same: exact 3D IoU >= 0.7 (>= 0.9 for different classes)"
)
BOX_OVERLAP = _warning("box-overlap", "two boxes of a class overlap: exact 3D IoU >= 0.3")
EMPTY_BOX = _warning("empty-box", "no point of the cloud lies in a box")
SPARSE_BOX = _note("sparse-box", "fewer than 5 points of the cloud lie in a box")
BOX_BEHIND_CAMERA = _error("box-behind-camera", "a box is fully behind the camera")
BOX_OUTSIDE_IMAGE = _error("box-outside-image", "a box is in front of the camera but fully outside the image")
HEADING_JUMP = _warning("heading-jump", "in a sequence a box has turned by more than 60 degrees in one frame")
IMAGE_BOX_OFF = _warning("image-box-off", "KITTI: the 2D box does not match the projection of the 3D box (IoU < 0.4)")
ALPHA_OFF = _warning(
    "alpha-off", "KITTI: alpha differs from the value that rotation_y and the position give by more than 0.3 rad"
)

# All boxes together
ANGLE_UNIT = _error("angle-unit", "angles are not in the unit of their format, such as degrees where it has radians")
LENGTH_UNIT = _error("length-unit", "the sizes of most boxes are not in metres, but in millimetres or centimetres")
QUATERNION_ORDER = _error("quaternion-order", "boxes stand upright only if their quaternions are read in another order")
SIZE_ORDER = _warning(
    "size-order", "most boxes of well-known classes have a usual size only if length, width or height are exchanged"
)
MIRRORED_BOXES = _error("mirrored-boxes", "more than half of the boxes hold no points, but their mirror images do")
FLAT_LABEL = _note("flat-label", "KITTI rows have a 2D box and no 3D box")

# Calibration
IMPOSSIBLE_CAMERA = _error("impossible-camera", "the focal lengths are impossible for images of this size")
CAMERA_OF_OTHER_SIZE = _warning("camera-of-other-size", "the principal point is far from the middle of the image")
CLOUD_SCALE = _warning("cloud-scale", "the points are so near or far that their unit is probably not metres")
CLOUD_OFF_DEPTH = _error("cloud-off-depth", "points of a depth camera do not project onto their own pixels")
CLOUD_OFF_IMAGE = _error("cloud-off-image", "many points of a depth camera project outside its image")
IMAGE_BARE = _warning("image-bare", "a LiDAR's points cover almost none of the image")
BOXES_OFF_CLOUD = _error("boxes-off-cloud", "more than half of a dataset's boxes contain no point")
BOXES_OFF_IMAGE = _error("boxes-off-image", "KITTI: more than half of a dataset's 2D boxes do not match the 3D boxes")
CALIBRATION_OFF = _warning("calibration-off", "edges in depth do not lie on edges of the image (4 frames or more)")
TIME_BACKWARDS = _warning("time-backwards", "in a sequence a frame is not later than the previous one")


class Finding(Strict):
    """One finding.

    Attributes:
        file: the file (or folder) with the problem.
        line: 1-based line number; None if the file has no lines.
        frame: key of the frame; None for a whole dataset.
    """

    rule: str
    severity: Severity
    file: str
    line: int | None
    frame: str | None
    message: str

    @property
    def place(self) -> str:
        """`file`, or `file:line`."""
        return self.file if self.line is None else f"{self.file}:{self.line}"


class Findings:
    """Collects findings; equal ones count once."""

    def __init__(self) -> None:
        self._found: dict[tuple[Rule, Path, int | None, str], Finding] = {}

    def add(self, rule: Rule, file: Path, message: str, *, line: int | None = None, frame: str | None = None) -> None:
        found = Finding(rule=rule.id, severity=rule.severity, file=str(file), line=line, frame=frame, message=message)
        # without the frame: a shared file is faulty once, not once per frame
        self._found.setdefault((rule, file, line, message), found)

    def add_error(self, rule: Rule, error: AnnotatorError, file: Path, *, frame: str | None = None) -> None:
        """Adds an error with its own file and line; `file` is used if it has none."""
        place, line = getattr(error, "path", file), getattr(error, "line", None)
        message = str(error).removeprefix(str(place)).removeprefix(f":{line}").removeprefix(": ")
        self.add(rule, place, message, line=line, frame=frame)

    def all(self) -> tuple[Finding, ...]:
        """Returns all findings by file and line."""
        return tuple(sorted(self._found.values(), key=lambda f: (f.file, f.line is None, f.line or 0)))
