"""Upright boxes of many images in one CSV file, for SUN RGB-D labels and detections.

    image,class,cx,cy,cz,l,w,h,yaw[,score]

z up, metres, radians: centre, full sizes, and the direction of the length, counter-clockwise from +x seen from above.
The frame is SUN RGB-D's "upright depth" (`sunrgbd.py`).
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.files import TABLE_BYTES, open_text_file
from annotator.formats.frame_names import LabelledFrame
from annotator.formats.reading import finite_number
from annotator.formats.sunrgbd import upright_frame
from annotator.formats.units import Angles, AngleUnit
from annotator.text import normal
from annotator.types import OrientedBox, Truth
from annotator.types.errors import FormatError

TEXTS = ("image", "class")
NUMBERS = ("cx", "cy", "cz", "l", "w", "h", "yaw")
SCORE = "score"
# Characters of the first line that tell the format.
FIRST_LINE = 1000


def read_upright_boxes(
    path: Path, angles: AngleUnit | None = None, *, scored: bool = False
) -> dict[str, LabelledFrame]:
    """Returns the objects of each image with a row, in upright depth, with their scores if the file has them.

    Args:
        angles: their unit; None: radians, as the format says.
        scored: True for detections: the column `score` is required.
    """
    read, images = Angles(angles), dict[str, list[Truth]]()
    try:
        with open_text_file(path, TABLE_BYTES, newline="") as file:
            for image, truth in _rows(path, file, scored, read):
                images.setdefault(image, []).append(truth)
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise FormatError(path, "is not UTF-8 text; save it as UTF-8") from error
    read.require()
    return {name: LabelledFrame(truths, upright_frame) for name, truths in images.items()}


def is_box_csv(path: Path) -> bool:
    """True if the first line names some columns of such a file; the others may be missing."""
    with suppress(OSError, UnicodeDecodeError, csv.Error), open_text_file(path, TABLE_BYTES) as file:
        names = {name.strip() for name in next(csv.reader([file.readline(FIRST_LINE)]), [])}
        return names.issuperset(TEXTS) and not names.isdisjoint(NUMBERS)
    return False


def _rows(path: Path, lines: Iterator[str], scored: bool, read: Angles) -> Iterator[tuple[str, Truth]]:
    reader = csv.reader(lines, strict=True)
    try:
        head = _head(path, next(reader, []), scored)
        for fields in reader:
            if any(field.strip() for field in fields):
                yield _row(path, reader.line_num, head, fields, read)
    except csv.Error as error:
        raise FormatError(path, f"is not valid CSV: {error}", reader.line_num) from error


def _head(path: Path, names: list[str], scored: bool) -> list[str]:
    head = [name.strip() for name in names]
    needed = [*TEXTS, *NUMBERS, *([SCORE] if scored else [])]
    if (missing := [name for name in needed if name not in head]) == [SCORE]:
        raise FormatError(
            path,
            "has no column score, so these are labels and no results; add the column (1.0 if all are equally certain), "
            "and give DETECTIONS before TRUTH",
            1,
        )
    if missing:
        raise FormatError(path, f"the first line must name the columns {','.join(needed)}; {missing[0]} is missing", 1)
    if unknown := [name for name in head if name not in (*needed, SCORE)]:
        raise FormatError(path, f"the column {unknown[0]!r} is unknown; use only {','.join(needed)}", 1)
    if len(set(head)) != len(head):
        raise FormatError(path, "two columns have the same name", 1)
    return head


def _row(path: Path, line: int, head: list[str], fields: list[str], read: Angles) -> tuple[str, Truth]:
    if len(fields) != len(head):
        hint = "; numbers need a decimal point, not a comma" if len(fields) > len(head) else ""
        raise FormatError(path, f"has {len(fields)} fields; the first line names {len(head)} columns{hint}", line)
    values = dict(zip(head, (field.strip() for field in fields), strict=True))
    if not (values["image"] and values["class"]):
        raise FormatError(path, "image and class must not be empty", line)
    *places, yaw = (finite_number(values[name], path, line, name) for name in NUMBERS)
    score = finite_number(values[SCORE], path, line, SCORE) if SCORE in values else None
    turn = Rotation.from_rotvec([0.0, 0.0, read.radians(yaw, path, line)])
    try:
        box = OrientedBox.at(RigidTransform.from_components(places[:3], turn), np.array(places[3:]))
        return normal(values["image"]), Truth(values["class"], box, score=score)
    except ValueError as error:
        raise FormatError(path, str(error), line) from error
