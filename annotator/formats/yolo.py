"""YOLO label files of 2D boxes: one text file per image, one line per box.

    CLASS CX CY W H [SCORE]
    CLASS X1 Y1 X2 Y2 X3 Y3 [X4 Y4 ...]
    CLASS CX CY W H X1 Y1 [VISIBILITY1] X2 Y2 [VISIBILITY2] ...

The second form is a turned box, by its four corners, or a polygon; it is read as the rectangle around these. The
third form has keypoints, which are not read; all rows of a dataset together show it (`are_keypoints`). The class is an
index into the dataset's `names`, from 0. Centre, width, height and corners are fractions of the image size,
measured from the image's corner (see `geometry/outline.py`). An empty file means an image without objects. A sixth
field is the score of a detection. Source: Ultralytics' documentation, overviews of datasets for "object detection",
"oriented bounding box" and "instance segmentation", and the checks in its `data/utils.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from annotator.formats.reading import OnFault, raise_fault
from annotator.geometry.outline import clip_to_image, edges_of, shares_of
from annotator.text import SHOWN, to_number
from annotator.types import Box2D
from annotator.types.errors import FormatError

# Ultralytics accepts boxes that extend beyond the image by this fraction of its size.
TOLERANCE = 0.01
FIELDS = "class cx cy w h"
# Numbers of a row after the class: a box, and with a score; and the corners of the least polygon.
BOX_NUMBERS, LEAST_CORNERS = (4, 5), 6
KEYPOINTS = "has keypoints ({}), which are not supported; keep the first five fields of rows"
# Numbers of a keypoint without and with its visibility: 0 = not labelled, 1 = hidden, 2 = visible.
POINT_NUMBERS, VISIBILITIES = (2, 3), (0, 1, 2)
# Distance of a box's size, read as a place, from its centre and points, of which there is one, or several; in sides of
# the rectangle around these. Triangles may be thin.
FAR = (6, 1)
# Rows that show that their boxes are full of points; a single polygon may do so by chance.
LEAST_FULL = 2
# Share of each side of such a box that its points cover, and distance of the box's centre from the edges of the points.
FULL, INNER = 0.5, 0.05


@dataclass(frozen=True)
class YoloBox:
    """One line of a label file.

    Attributes:
        label: class name.
        shares: cx, cy, w, h as fractions of the image size.
        score: 1 if absent.
        is_around: it is the rectangle around a turned box or a polygon.
        corners: x1 y1 x2 y2 ... of that; else ().
    """

    label: str
    shares: tuple[float, float, float, float]
    score: float = 1.0
    is_around: bool = False
    corners: tuple[float, ...] = field(default=(), compare=False, repr=False)

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
    # a visibility of 2 is no place in the image
    if not is_box and max(edges) > 1 + TOLERANCE and _are_keypoints(np.array([numbers]), max(POINT_NUMBERS)):
        raise FormatError(path, KEYPOINTS.format("cx cy w h x y visibility ..."), line)
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
    corners = () if is_box else tuple(numbers)
    return YoloBox(names[class_number], (cx, cy, w, h), score, not is_box, corners)


def _around(corners: Sequence[float]) -> tuple[float, float, float, float]:
    """Returns cx, cy, w, h of the rectangle around the corners x1 y1 x2 y2 ..."""
    left, right, top, bottom = min(corners[::2]), max(corners[::2]), min(corners[1::2]), max(corners[1::2])
    return (left + right) / 2, (top + bottom) / 2, right - left, bottom - top


def are_keypoints(boxes: Iterable[YoloBox]) -> bool:
    """True if the rows that were read as polygons are boxes with keypoints.

    All rows must have the same number of points, and their first four numbers must be a box that holds all points
    behind it. Small polygons may look so, too. But a polygon's second corner is near the others, where the second pair
    of a box is its size; and a polygon's first corner is seldom in the middle of the others.
    """
    rows = [box.corners for box in boxes if box.corners]
    if len(set(map(len, rows))) != 1:
        return False
    table = np.array(rows)
    return any(_are_keypoints(table, numbers) for numbers in POINT_NUMBERS)


def _are_keypoints(rows: Float64[np.ndarray, "n c"], numbers: int) -> bool:
    if (rows.shape[1] - 4) % numbers:
        return False
    centers, sizes = rows[:, None, :2], rows[:, None, 2:4]
    points = rows[:, 4:].reshape(len(rows), -1, numbers)
    xy, visibilities = points[..., :2], points[..., 2:]
    if not np.isin(visibilities, VISIBILITIES).all():
        return False
    # tools write 0 0 for points that are not labelled
    missing = (xy == 0).all(axis=2) | (visibilities == 0).any(axis=2)
    low, high = centers - sizes / 2 - TOLERANCE, centers + sizes / 2 + TOLERANCE
    is_held = ((xy >= low) & (xy <= high)).all(axis=2) | missing
    if not (is_held.all() and (sizes > 0).all() and low.min() >= -2 * TOLERANCE and high.max() <= 1 + 2 * TOLERANCE):
        return False
    if numbers == max(POINT_NUMBERS):
        return True
    xy = np.where(missing[..., None], centers, xy)
    first, last = np.minimum(xy.min(axis=1), centers[:, 0]), np.maximum(xy.max(axis=1), centers[:, 0])
    beside = np.maximum(first - sizes[:, 0], sizes[:, 0] - last).max(axis=1)
    is_far = (beside > FAR[xy.shape[1] > 1] * (last - first).max(axis=1)) & ~missing.all(axis=1)
    sides, inner = xy.max(axis=1) - xy.min(axis=1), centers[:, 0]
    is_inner = (inner > xy.min(axis=1) + INNER * sides) & (inner < xy.max(axis=1) - INNER * sides)
    is_full = (is_inner & (sides >= FULL * sizes[:, 0])).all(axis=1)
    return bool(is_far.mean() > 0.5 or (len(rows) >= LEAST_FULL and is_full.mean() > 0.5))
