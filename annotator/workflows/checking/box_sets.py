"""Rules about all boxes of a dataset together: units, the order of the sizes, and mirrored axes.

Each gives one finding, with the number of boxes that show it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from annotator.formats.units import Angles
from annotator.geometry.oriented_box import contains
from annotator.types import OrientedBox
from annotator.types.errors import AnnotatorError, UnitError, UnitKind
from annotator.types.messages import amount
from annotator.workflows.checking.box_rules import LEAST_POINTS
from annotator.workflows.checking.findings import Findings
from annotator.workflows.checking.label_files import FoundLabel
from annotator.workflows.checking.rules import (
    ANGLE_UNIT,
    BROKEN_LABEL,
    LENGTH_UNIT,
    MIRRORED_BOXES,
    QUATERNION_ORDER,
    SIZE_ORDER,
    Rule,
)
from annotator.workflows.importing.size_doubts import SizeDoubts

RULE_OF = {
    UnitKind.ANGLE: ANGLE_UNIT,
    UnitKind.LENGTH: LENGTH_UNIT,
    UnitKind.QUATERNION: QUATERNION_ORDER,
}
# Two boxes without points are seldom both mirror images of objects by chance.
LEAST_MIRRORED = 2
# The axes of the camera frame that may be mirrored; a box mirrored in the third one is behind the camera.
MIRRORED = {0: "left and right", 1: "up and down"}


def rule_of(error: AnnotatorError) -> Rule:
    """Returns the rule that a label file breaks which cannot be read."""
    return RULE_OF[error.kind] if isinstance(error, UnitError) else BROKEN_LABEL


def report_sizes(sizes: SizeDoubts, findings: Findings, path: Path) -> None:
    """Adds what the sizes of a dataset's boxes show to `findings`."""
    if (problem := sizes.lengths.problem()) is not None:
        findings.add(LENGTH_UNIT, path, problem)
    elif (problem := sizes.orders.problem()) is not None:
        findings.add(SIZE_ORDER, path, problem)


class BoxSet:
    """The boxes of a dataset so far."""

    def __init__(self) -> None:
        self._angles, self._sizes = Angles(), SizeDoubts()
        self._boxes = 0
        self._mirrored: Counter[int] = Counter()

    def add(self, entry: FoundLabel) -> None:
        """Adds the numbers of a label."""
        if entry.row is not None and entry.line is not None:
            self._angles.radians(entry.row.rotation_y, entry.file, entry.line)
        self._sizes.add(entry.truth.label, entry.truth.box.size_m)

    def add_points(self, xyz_m: Float32[np.ndarray, "n 3"], boxes: int, empty: Sequence[OrientedBox]) -> None:
        """Adds a frame.

        Args:
            xyz_m: its points.
            boxes: how many boxes it has.
            empty: those of them without points.
        """
        self._boxes += boxes
        for axis in MIRRORED:
            counts = (int(np.count_nonzero(contains(mirrored(box, axis), xyz_m))) for box in empty)
            self._mirrored[axis] += sum(count >= LEAST_POINTS for count in counts)

    def report(self, findings: Findings, path: Path) -> None:
        """Adds what the boxes show to `findings`; `path` is the dataset."""
        try:
            self._angles.require()
        except UnitError as error:
            findings.add_error(ANGLE_UNIT, error, path)
        report_sizes(self._sizes, findings, path)
        axis, number = max(self._mirrored.items(), key=lambda each: each[1], default=(0, 0))
        if number >= LEAST_MIRRORED and number * 2 > self._boxes:
            message = (
                f"{number} of {amount(self._boxes, 'box')} hold no points, but their mirror images do, with "
                f"{MIRRORED[axis]} exchanged; the labels' axes are probably left-handed"
            )
            findings.add(MIRRORED_BOXES, path, message)


def mirrored(box: OrientedBox, axis: int) -> OrientedBox:
    """Returns the mirror image of a box in the plane through the origin across an axis of its frame."""
    flip = np.ones(3)
    flip[axis] = -1
    # a box is its own mirror image along its width, which keeps the rotation proper
    return OrientedBox.from_parts(flip * box.center_m, flip[:, None] * box.rotation * [1.0, -1.0, 1.0], box.size_m)
