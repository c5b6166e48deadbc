"""Upright boxes of many images in one CSV file, for SUN RGB-D labels and detections.

    image,class,cx,cy,cz,l,w,h,yaw[,score]

z up, metres, radians: centre, full sizes, and the direction of the length, counter-clockwise from +x seen from above.
The frame is SUN RGB-D's "upright depth" (`sunrgbd.py`).
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
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


@dataclass(frozen=True)
class BoxRow:
    """One row: `center_m` x y z, `size_m` length width height, `yaw_rad` about z."""

    image: str
    label: str
    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    yaw_rad: float
    score: float | None = None


def read_box_csv(path: Path, *, scored: bool, angles: AngleUnit | None = None) -> list[BoxRow]:
    """Returns the rows in file order; blank lines are skipped.

    Args:
        scored: True for detections: the column `score` is required.
        angles: their unit; None: radians, as the format says.
    """
    read = Angles(angles)
    try:
        with open_text_file(path, TABLE_BYTES, newline="") as file:
            rows = list(_rows(path, file, scored, read))
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise FormatError(path, "is not UTF-8 text; save it as UTF-8") from error
    read.require()
    return rows


def is_box_csv(path: Path) -> bool:
    """True if the first line names some columns of such a file; the others may be missing."""
    with suppress(OSError, UnicodeDecodeError, csv.Error), open_text_file(path, TABLE_BYTES) as file:
        names = {name.strip() for name in next(csv.reader([file.readline(FIRST_LINE)]), [])}
        return names.issuperset(TEXTS) and not names.isdisjoint(NUMBERS)
    return False


def read_upright_boxes(path: Path, angles: AngleUnit | None = None) -> dict[str, LabelledFrame]:
    """Returns the objects of each image with a row, in upright depth, with their scores if the file has them.

    Args:
        angles: their unit; None: radians, as the format says.
    """
    images: dict[str, list[Truth]] = {}
    for row in read_box_csv(path, scored=False, angles=angles):
        try:
            images.setdefault(row.image, []).append(_truth(row))
        except ValueError as error:
            raise FormatError(path, f"{row.image}: {row.label}: {error}") from error
    return {name: LabelledFrame(truths, upright_frame) for name, truths in images.items()}


def _truth(row: BoxRow) -> Truth:
    turn = Rotation.from_rotvec([0.0, 0.0, row.yaw_rad])
    pose = RigidTransform.from_components(np.array(row.center_m), turn)
    return Truth(row.label, OrientedBox.at(pose, np.array(row.size_m)), score=row.score)


def _rows(path: Path, lines: Iterator[str], scored: bool, read: Angles) -> Iterator[BoxRow]:
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


def _row(path: Path, line: int, head: list[str], fields: list[str], read: Angles) -> BoxRow:
    if len(fields) != len(head):
        hint = "; numbers need a decimal point, not a comma" if len(fields) > len(head) else ""
        raise FormatError(path, f"has {len(fields)} fields; the first line names {len(head)} columns{hint}", line)
    values = dict(zip(head, (field.strip() for field in fields), strict=True))
    if not (values["image"] and values["class"]):
        raise FormatError(path, "image and class must not be empty", line)
    cx, cy, cz, length, width, height, yaw = (finite_number(values[name], path, line, name) for name in NUMBERS)
    if min(length, width, height) <= 0:
        raise FormatError(path, f"l w h must be positive, not {length:g} {width:g} {height:g}", line)
    score = finite_number(values[SCORE], path, line, SCORE) if SCORE in values else None
    yaw_rad = read.radians(yaw, path, line)
    return BoxRow(normal(values["image"]), values["class"], (cx, cy, cz), (length, width, height), yaw_rad, score)
