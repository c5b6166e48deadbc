"""YOLO label files of 2D boxes: one text file per image, one line per box.

    CLASS CX CY W H [SCORE]
    CLASS X1 Y1 X2 Y2 X3 Y3 [X4 Y4 ...]

The second form is a turned box, by its four corners, or a polygon; it is read as the rectangle around these. The class
is an index into the dataset's `names`, from 0. Centre, width, height and corners are fractions of the image size,
measured from the image's corner (see `geometry/image_shares.py`). An empty file means an image without objects. A sixth
field is the score of a detection. Source: Ultralytics' documentation, overviews of datasets for "object detection",
"oriented bounding box" and "instance segmentation", and the checks in its `data/utils.py`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from annotator.formats.reading import OnFault, raise_fault
from annotator.geometry.image_shares import clip_to_image, edges_of, shares_of
from annotator.text import SHOWN, to_number
from annotator.types import Box2D
from annotator.types.errors import FormatError

# Ultralytics accepts boxes that extend beyond the image by this fraction of its size.
TOLERANCE = 0.01
FIELDS = "class cx cy w h"
# Numbers of a row after the class: a box, and with a score; and the corners of the least polygon.
BOX_NUMBERS, LEAST_CORNERS = (4, 5), 6


@dataclass(frozen=True)
class YoloBox:
    """One line of a label file.

    Attributes:
        label: class name.
        shares: cx, cy, w, h as fractions of the image size.
        score: 1 if absent.
        is_around: it is the rectangle around a turned box or a polygon.
    """

    label: str
    shares: tuple[float, float, float, float]
    score: float = 1.0
    is_around: bool = False

    def on(self, width_px: int, height_px: int) -> Box2D:
        """Returns the box in pixels of an image of that size, clipped to the image."""
        edges = edges_of(np.array(self.shares), width_px, height_px)
        x_min, y_min, x_max, y_max = map(float, edges)
        box = Box2D(self.label, x_min, y_min, x_max, y_max, self.score)
        cut = clip_to_image(box, width_px, height_px)
        assert cut is not None  # `parse_boxes` rejects boxes outside the image
        return cut


def dump_boxes(boxes: Sequence[Box2D], numbers: Mapping[str, int], width_px: int, height_px: int) -> str:
    """Returns the text of a label file, without scores, as training files have none.

    Args:
        boxes: within the image.
        numbers: class numbers by name.
    """
    lines = []
    for box in boxes:
        shares = shares_of(box, width_px, height_px)
        lines.append(" ".join([str(numbers[box.label]), *(f"{share:.7f}" for share in shares)]) + "\n")
    return "".join(lines)


def parse_boxes(
    path: Path, text: str, names: Mapping[int, str], on_fault: OnFault = raise_fault
) -> tuple[YoloBox, ...]:
    """Returns the boxes of a label file in file order.

    Args:
        path: for error messages.
        names: class names by number.
        on_fault: called with the fault of a row; see `OnFault`.

    Raises:
        FormatError: a wrong number of fields, a field that is not a number, a class without a name, a box
            without extent, a box that extends beyond the image by more than `TOLERANCE`, or the same line twice; names
            the line.
    """
    boxes: dict[YoloBox, int] = {}
    for line, row in enumerate(text.splitlines(), 1):
        if not row.strip():
            continue
        try:
            box = _box(path, line, row.split(), names)
        except FormatError as fault:
            on_fault(fault)
            continue
        if box in boxes:
            on_fault(FormatError(path, f"the same box as in line {boxes[box]}; keep one of them", line))
        boxes[box] = line
    return tuple(boxes)


def _box(path: Path, line: int, fields: list[str], names: Mapping[int, str]) -> YoloBox:
    is_box = len(fields) - 1 in BOX_NUMBERS
    if not is_box and (len(fields) - 1 < LEAST_CORNERS or len(fields) % 2 == 0):
        raise FormatError(
            path,
            f"has {len(fields)} fields; a box has {FIELDS} [score], a turned box or a polygon has class x1 y1 x2 y2 x3 "
            "y3 ..., and keypoints are not supported",
            line,
        )
    if not fields[0].removeprefix("-").isdecimal():
        raise FormatError(
            path, f"must hold numbers ({FIELDS}); {fields[0][:SHOWN]!r} is not the number of a class", line
        )
    try:
        class_number, numbers = int(fields[0]), list(map(to_number, fields[1:]))
    except ValueError as error:
        raise FormatError(path, f"must hold numbers ({FIELDS}): {error}", line) from None
    if class_number not in names:
        raise FormatError(
            path, f"class {class_number} has no name; classes with a name go from 0 to {max(names, default=-1)}", line
        )
    if not all(map(math.isfinite, numbers)):
        raise FormatError(path, "all numbers must be finite", line)
    cx, cy, w, h = numbers[:4] if is_box else _around(numbers)
    score = numbers[4] if len(numbers) == 5 else 1.0
    if not 0 <= score <= 1:
        raise FormatError(path, f"the score must be in 0..1, not {score:g}", line)
    edges = (cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2)
    if min(w, h) <= 0 or min(edges) < -TOLERANCE or max(edges) > 1 + TOLERANCE:
        raise FormatError(
            path,
            f"cx cy w h must be fractions of the image size that describe a non-empty box inside the image, not "
            f"{cx:g} {cy:g} {w:g} {h:g}",
            line,
        )
    # a smaller box has no extent once it is clipped to an image of any size
    if min(edges[2], 1) - max(edges[0], 0) < 1e-9 or min(edges[3], 1) - max(edges[1], 0) < 1e-9:
        raise FormatError(path, "the box is outside the image", line)
    return YoloBox(names[class_number], (cx, cy, w, h), score, not is_box)


def _around(corners: Sequence[float]) -> tuple[float, float, float, float]:
    """Returns cx, cy, w, h of the rectangle around the corners x1 y1 x2 y2 ..."""
    left, right, top, bottom = min(corners[::2]), max(corners[::2]), min(corners[1::2]), max(corners[1::2])
    return (left + right) / 2, (top + bottom) / 2, right - left, bottom - top
