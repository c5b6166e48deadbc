"""Files of the boxes of many frames: `boxes.json`, and CSV.

`boxes.json` has the ground-truth oriented boxes of an RGB-D folder, or of generated scans, by frame.

    {"000012": {"label": "hand", "center": [x, y, z], "size": [l, w, h], "rotation": [[..], [..], [..]]}, ...}

A frame has one object or a list of objects. Metres, camera frame; of scans, their own. `rotation` is 3x3, a list of
rows; its columns are the box's axes. `size` holds the full lengths along them. Optional: `corners` (8x3, checked
against the rest) and `track` (the object's number in the recording), `score` (of a detector), and `attributes` (values
by name). Other keys are ignored.

A CSV file has upright boxes of many images, for SUN RGB-D labels and detections.

    image,class,cx,cy,cz,l,w,h,yaw[,score]

z up, metres, radians: centre, full sizes, and the direction of the length, counter-clockwise from +x seen from above.
The frame is SUN RGB-D's "upright depth" (`sunrgbd.py`).
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from annotator.files import TABLE_BYTES, open_text_file
from annotator.formats.frame_names import LabelledFrame
from annotator.formats.reading import Angles, AngleUnit, faults, finite_number, read_object, write_text
from annotator.formats.sunrgbd import upright_frame
from annotator.geometry.oriented_box import box_corners
from annotator.text import normal
from annotator.types import OrientedBox, Truth
from annotator.types.bases import FileRecord, TrackId
from annotator.types.boxes import FARTHEST_M
from annotator.types.errors import FormatError

Number = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)]
Vector = tuple[Number, Number, Number]
# Tolerance between `corners` and the box: some files round to millimetres.
CORNERS_AGREE_M = 2e-3


class BoxEntry(FileRecord):
    """One object of one frame, as stored in the file."""

    label: Annotated[str, Field(min_length=1)]
    center: Vector
    size: Vector
    rotation: tuple[Vector, Vector, Vector]
    corners: Annotated[tuple[Vector, ...], Field(min_length=8, max_length=8)] | None = None
    track: TrackId | None = None
    score: Number | None = None
    attributes: dict[str, bool | int | Number | str] = Field(default_factory=dict)


# The usual name of a file of boxes, and where a recording has it.
NAME = "boxes.json"
PLACES = (f"truth/{NAME}", NAME)


def boxes_file(path: Path) -> Path:
    """The file of boxes at `path`, which may also be the folder of a recording."""
    if not path.is_dir():
        return path
    found = next((path / place for place in PLACES if (path / place).is_file()), None)
    if found is None:
        raise FormatError(path, f"has no {' and no '.join(PLACES)}; give the file of boxes")
    return found


def read_boxes(path: Path) -> dict[str, list[Truth]]:
    """Returns the ground-truth objects of every frame in the file, by frame key; a frame may have none."""
    return {
        key: [entry_truth(entry, path, key, number) for number, entry in enumerate(entries)]
        for key, entries in each_entries(path)
    }


def write_boxes(path: Path, frames: Mapping[str, Sequence[Truth]]) -> None:
    """Writes the boxes of every frame, by frame key; `read_boxes` returns the same boxes. Scores are not written."""
    content = {
        key: [
            {
                "label": truth.label,
                "center": truth.box.center_m.tolist(),
                "size": truth.box.size_m.tolist(),
                "rotation": truth.box.rotation.tolist(),
            }
            | ({} if truth.track_id is None else {"track": truth.track_id})
            | ({"attributes": dict(truth.attributes)} if truth.attributes else {})
            for truth in truths
        ]
        for key, truths in frames.items()
    }
    write_text(path, json.dumps(content, indent=1) + "\n")


def each_entries(path: Path) -> Iterator[tuple[str, list[object]]]:
    """Yields each frame's key and entries, unchecked; `entry_truth` checks one."""
    for key, value in read_object(path).items():
        yield key, value if isinstance(value, list) else [value]


def entry_truth(value: object, path: Path, key: str, number: int) -> Truth:
    """Returns the object of one entry; `number` counts the frame's entries from 0."""
    with faults(path, f"{key}.{number}: "):
        entry = BoxEntry.model_validate(value)
    with faults(path, f"frame {key}, {entry.label}: "):
        box = OrientedBox.from_parts(np.array(entry.center), np.array(entry.rotation), np.array(entry.size))
        if entry.corners is not None:
            gaps = np.linalg.norm(np.array(entry.corners)[:, None] - box_corners(box), axis=2).min(axis=1)
            if gaps.max() > CORNERS_AGREE_M:
                raise ValueError(
                    f"corners differ by up to {gaps.max():.3f} m from center, size and rotation; write rotation row by "
                    "row and size as full lengths"
                )
    return Truth(entry.label, box, entry.track, entry.score, attributes=entry.attributes)


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
    with faults(path), open_text_file(path, TABLE_BYTES, newline="") as file:
        for image, truth in _rows(path, file, scored, read):
            images.setdefault(image, []).append(truth)
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
    x, y, z, *size_m, yaw = (finite_number(values[name], path, line, name) for name in NUMBERS)
    score = finite_number(values[SCORE], path, line, SCORE) if SCORE in values else None
    yaw_rad = read.radians(yaw, path, line)
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    # not scipy's transforms, which take most of the time of a file of detections
    pose = [[cosine, -sine, 0.0, x], [sine, cosine, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]]
    with faults(path, line=line):
        box = OrientedBox(np.array(pose), np.array(size_m))
        return normal(values["image"]), Truth(values["class"], box, score=score)
