"""YOLO's label files of 2D boxes: one text file a picture, one line a box.

    CLASS CX CY W H [SCORE]

The class is a number into the dataset's `names`, from 0. Centre, width and height are shares of the picture's size,
measured from its corner (see `geometry/image_shares.py`); a file without a line is a picture that shows nothing. A
sixth field is the score of a detection. Source: Ultralytics' documentation, "object detection datasets overview", and
the checks in its `data/utils.py`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from annotator.formats.faults import Tell, give_up
from annotator.geometry.image_shares import cut_to_picture, edges_of, shares_of
from annotator.types import Box2D
from annotator.types.errors import FormatError

# Ultralytics takes boxes that stick out of their picture by so much of its size.
TOLERANCE = 0.01
FIELDS = "class cx cy w h"


@dataclass(frozen=True)
class YoloBox:
    """One line of a label file: class name, shares (cx, cy, w, h) of the picture, score (1 if there is none)."""

    label: str
    shares: tuple[float, float, float, float]
    score: float = 1.0

    def on(self, width_px: int, height_px: int) -> Box2D:
        """The box on a picture of that size, pixels, clipped to the picture."""
        edges = edges_of(np.array(self.shares), width_px, height_px)
        x_min, y_min, x_max, y_max = map(float, edges)
        box = Box2D(self.label, x_min, y_min, x_max, y_max, self.score)
        cut = cut_to_picture(box, width_px, height_px)
        assert cut is not None  # `parse_boxes` takes no box outside
        return cut


def dump_boxes(boxes: Sequence[Box2D], numbers: Mapping[str, int], width_px: int, height_px: int) -> str:
    """The text of a label file; scores are left out, as in files to learn from.

    Args:
        boxes: within the picture.
        numbers: of the classes.
    """
    lines = []
    for box in boxes:
        shares = shares_of(box, width_px, height_px)
        lines.append(" ".join([str(numbers[box.label]), *(f"{share:.7f}" for share in shares)]) + "\n")
    return "".join(lines)


def parse_boxes(path: Path, text: str, names: Mapping[int, str], tell: Tell = give_up) -> tuple[YoloBox, ...]:
    """The boxes of a label file in its order.

    Args:
        path: for messages.
        names: of the classes, by number.
        tell: what becomes of a row's fault.

    Raises:
        FormatError: with the line: not five or six fields (a polygon, keypoints), no number, a class that has no name,
            a box without extent or one that lies outside the picture by more than `TOLERANCE`, the same line twice.
    """
    boxes: dict[YoloBox, int] = {}
    for line, row in enumerate(text.splitlines(), 1):
        if not row.strip():
            continue
        try:
            box = _box(path, line, row.split(), names)
        except FormatError as fault:
            tell(fault)
            continue
        if box in boxes:
            tell(FormatError(path, f"the same box as in line {boxes[box]}; keep one of them", line))
        boxes[box] = line
    return tuple(boxes)


def _box(path: Path, line: int, fields: list[str], names: Mapping[int, str]) -> YoloBox:
    if len(fields) not in (5, 6):
        raise FormatError(
            path, f"has {len(fields)} fields; a box has {FIELDS} (and a score), polygons and points are not read", line
        )
    try:
        number, numbers = int(fields[0]), [float(field.replace("_", "?")) for field in fields[1:]]
    except ValueError:
        raise FormatError(path, f"must hold numbers ({FIELDS}), not {' '.join(fields)[:80]!r}", line) from None
    if number not in names:
        raise FormatError(path, f"class {number} has no name; the names go from 0 to {max(names, default=-1)}", line)
    if not all(map(math.isfinite, numbers)):
        raise FormatError(path, "every number must be finite", line)
    cx, cy, w, h = numbers[:4]
    score = numbers[4] if len(numbers) == 5 else 1.0
    if not 0 <= score <= 1:
        raise FormatError(path, f"the score must lie in 0..1, not {score:g}", line)
    edges = (cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2)
    if min(w, h) <= 0 or min(edges) < -TOLERANCE or max(edges) > 1 + TOLERANCE:
        raise FormatError(
            path,
            f"cx cy w h are shares of the picture, and the box must have an extent and lie in it; {cx:g} {cy:g} {w:g} "
            f"{h:g} does not",
            line,
        )
    # less than this is nothing once it is cut to a picture of any size
    if min(edges[2], 1) - max(edges[0], 0) < 1e-9 or min(edges[3], 1) - max(edges[1], 0) < 1e-9:
        raise FormatError(path, "nothing of the box is on the picture", line)
    return YoloBox(names[number], (cx, cy, w, h), score)
