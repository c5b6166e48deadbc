"""The rules of the dataset check, and what one check finds.

`docs/checks.md` tells what each rule finds. Ids and severities are stable: programs may rely on them.
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
    """A rule; `docs/checks.md` tells what it finds."""

    id: str
    severity: Severity


RULES: dict[str, Rule] = {}


def _rule(severity: Severity, rule_id: str) -> Rule:
    return RULES.setdefault(rule_id, Rule(rule_id, severity))


_error, _warning, _note = (partial(_rule, severity) for severity in Severity)

# Files
UNREADABLE_DATASET = _error("unreadable-dataset")
MISSING_FILE = _error("missing-file")
UNREADABLE_FILE = _error("unreadable-file")
UNCLEAR_FILE = _error("unclear-file")
UNREADABLE_CALIBRATION = _error("unreadable-calibration")
UNREADABLE_MASK = _error("unreadable-mask")
MISSING_LABELS = _error("missing-labels")
STRAY_FILE = _error("stray-file")
MANIFEST_MISMATCH = _error("manifest-mismatch")
UNCHECKED_DATASET = _note("unchecked-dataset")

# Rows
BROKEN_LABEL = _error("broken-label")
FIELD_RANGE = _warning("field-range")
CLASS_SPELLING = _warning("class-spelling")
TRACK_TWICE = _error("track-twice")
TRACK_CLASS = _warning("track-class")

# Boxes
IMPOSSIBLE_SIZE = _error("impossible-size")
IMPOSSIBLE_PLACE = _error("impossible-place")
ODD_SIZE = _warning("odd-size")
DUPLICATE_LABEL = _error("duplicate-label")
BOX_OVERLAP = _warning("box-overlap")
EMPTY_BOX = _warning("empty-box")
SPARSE_BOX = _note("sparse-box")
BOX_BEHIND_CAMERA = _error("box-behind-camera")
BOX_OUTSIDE_IMAGE = _error("box-outside-image")
HEADING_JUMP = _warning("heading-jump")
IMAGE_BOX_OFF = _warning("image-box-off")
ALPHA_OFF = _warning("alpha-off")

# All boxes together
ANGLE_UNIT = _error("angle-unit")
LENGTH_UNIT = _error("length-unit")
QUATERNION_ORDER = _error("quaternion-order")
SIZE_ORDER = _warning("size-order")
MIRRORED_BOXES = _error("mirrored-boxes")
FLAT_LABEL = _note("flat-label")

# Calibration
IMPOSSIBLE_CAMERA = _error("impossible-camera")
CAMERA_OF_OTHER_SIZE = _warning("camera-of-other-size")
CLOUD_SCALE = _warning("cloud-scale")
CLOUD_OFF_DEPTH = _error("cloud-off-depth")
CLOUD_OFF_IMAGE = _error("cloud-off-image")
IMAGE_BARE = _warning("image-bare")
BOXES_OFF_CLOUD = _error("boxes-off-cloud")
BOXES_OFF_IMAGE = _error("boxes-off-image")
CALIBRATION_OFF = _warning("calibration-off")
TIME_BACKWARDS = _warning("time-backwards")

# Poses
POSE_GAP = _note("pose-gap")
POSE_JUMP = _warning("pose-jump")
STILL_WORLD_MOVES = _warning("still-world-moves")


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
        # without the frame: a shared file is faulty once, not once per frame
        key = (rule, file, line, message)
        if key not in self._found:
            self._found[key] = Finding(
                rule=rule.id, severity=rule.severity, file=str(file), line=line, frame=frame, message=message
            )

    def add_error(self, rule: Rule, error: AnnotatorError, file: Path, *, frame: str | None = None) -> None:
        """Adds an error with its own file and line; `file` is used if it has none."""
        place, line = getattr(error, "path", file), getattr(error, "line", None)
        message = str(error).removeprefix(str(place)).removeprefix(f":{line}").removeprefix(": ")
        self.add(rule, place, message, line=line, frame=frame)

    def all(self) -> tuple[Finding, ...]:
        """Returns all findings by file and line."""
        return tuple(sorted(self._found.values(), key=lambda f: (f.file, f.line is None, f.line or 0)))
