"""Rules about all boxes of a dataset together: units, the order of the sizes, and mirrored axes.

Each gives one finding, with the number of boxes that show it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import permutations
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from annotator.formats.units import Angles, Lengths
from annotator.geometry.point_index import PointIndex
from annotator.rcv.typical_size.sizes import TypicalSize, typical_size
from annotator.types import OrientedBox
from annotator.types.amounts import amount
from annotator.types.errors import AnnotatorError, UnitError, UnitKind
from annotator.workflows.checking.box_rules import LEAST_POINTS, SIZE_FACTOR, size_message
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

RULE_OF = {
    UnitKind.ANGLE: ANGLE_UNIT,
    UnitKind.LENGTH: LENGTH_UNIT,
    UnitKind.QUATERNION: QUATERNION_ORDER,
}
# Standard deviations of a class's sides within which a size is usual.
SIZE_DEVIATIONS = 3.0
# A class with a side this much longer than another one shows the order of sizes by itself; others need several boxes.
CLEAR_FACTOR, LEAST_UNCLEAR = 2.0, 3
SIDES = ("length", "width", "height")
# Two boxes without points are seldom both mirror images of objects by chance.
LEAST_MIRRORED = 2
# The axes of the camera frame that may be mirrored; a box mirrored in the third one is behind the camera.
MIRRORED = {0: "left and right", 1: "up and down"}


def rule_of(error: AnnotatorError) -> Rule:
    """Returns the rule that a label file breaks which cannot be read."""
    return RULE_OF[error.kind] if isinstance(error, UnitError) else BROKEN_LABEL


class BoxSet:
    """The boxes of a dataset so far."""

    def __init__(self) -> None:
        self._angles, self._lengths, self._orders = Angles(), Lengths(), SizeOrders()
        self._boxes = 0
        self._mirrored: Counter[int] = Counter()

    def add(self, entry: FoundLabel) -> None:
        """Adds the numbers of a label."""
        if entry.row is not None and entry.line is not None:
            self._angles.radians(entry.row.rotation_y, entry.file, entry.line)
        self._lengths.add(entry.truth.box.size_m)
        self._orders.add(entry.truth.label, entry.truth.box.size_m)

    def add_points(self, xyz_m: Float32[np.ndarray, "n 3"], boxes: int, empty: Sequence[OrientedBox]) -> None:
        """Adds a frame.

        Args:
            xyz_m: its points.
            boxes: how many boxes it has.
            empty: those of them without points.
        """
        self._boxes += boxes
        if empty:
            index = PointIndex.of(xyz_m)
            for axis in MIRRORED:
                self._mirrored[axis] += sum(index.count(mirrored(box, axis)) >= LEAST_POINTS for box in empty)

    def report(self, findings: Findings, path: Path) -> None:
        """Adds what the boxes show to `findings`; `path` is the dataset."""
        try:
            self._angles.require()
        except UnitError as error:
            findings.add_error(ANGLE_UNIT, error, path)
        if (problem := self._lengths.problem()) is not None:
            findings.add(LENGTH_UNIT, path, problem)
        elif (problem := self._orders.problem()) is not None:
            findings.add(SIZE_ORDER, path, problem)
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


class SizeOrders:
    """Whether the sizes of boxes of well-known classes are in the order length, width, height."""

    def __init__(self) -> None:
        self._known = self._clear = 0
        self._orders: Counter[tuple[int, ...]] = Counter()
        self._example: dict[tuple[int, ...], str] = {}

    def add(self, label: str, size_m: Float64[np.ndarray, "3"]) -> None:
        """Adds the size of a box; one of another class shows nothing."""
        usual = typical_size(label)
        if usual is None:
            return
        self._known += 1
        order = _order(usual, size_m)
        if order is not None:
            self._orders[order] += 1
            self._clear += max(usual.size_m) > CLEAR_FACTOR * min(usual.size_m)
            self._example.setdefault(order, size_message(label, size_m))

    def problem(self) -> str | None:
        """Returns which order most boxes show; None if it is the right one."""
        odd = self._orders.total()
        if odd * 2 <= self._known or (self._clear == 0 and odd < LEAST_UNCLEAR):
            return None
        order, number = self._orders.most_common(1)[0]
        moved = [name for place, name in enumerate(SIDES) if order[place] != place]
        return (
            f"{number} of {amount(self._known, 'box')} of well-known classes {'has' if number == 1 else 'have'} the "
            f"usual size of the class only if {', '.join(moved[:-1])} and {moved[-1]} are exchanged, such as "
            f"{self._example[order]}; check the order in which the sizes are written"
        )


def _order(usual: TypicalSize, size_m: Float64[np.ndarray, "3"]) -> tuple[int, ...] | None:
    """Returns the order of the sides that is usual for the class; None if the present one is, or none is.

    Furniture may be wider than long; vehicles, whose length is `CLEAR_FACTOR` of their width, may not.
    """
    within = np.log(np.maximum(SIZE_FACTOR, np.exp(SIZE_DEVIATIONS * np.array(usual.spread))))
    fitting = {
        order: float(off.max())
        for order in permutations(range(3))
        if (off := np.abs(np.log(size_m[list(order)] / np.array(usual.size_m))) / within).max() <= 1
    }
    is_long = usual.size_m[0] > CLEAR_FACTOR * usual.size_m[1]
    if not fitting or (0, 1, 2) in fitting or (not is_long and (1, 0, 2) in fitting):
        return None
    return min(fitting, key=lambda order: fitting[order])
