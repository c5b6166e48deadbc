"""`boxes.json`: the ground-truth oriented boxes of an RGB-D folder, by frame.

    {"000012": {"label": "hand", "center": [x, y, z], "size": [l, w, h], "rotation": [[..], [..], [..]]}, ...}

A frame has one object or a list of objects. Metres, camera frame. `rotation` is 3x3, a list of rows; its columns are
the box's axes. `size` holds the full lengths along them. Optional: `corners` (8x3, checked against the rest) and
`track` (the object's number in the recording), `score` (of a detector), and `attributes` (values by name). Other keys
are ignored.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, ValidationError

from annotator.formats.reading import BoundedTrack, read_object, write_text
from annotator.geometry.oriented_box import box_corners
from annotator.types import OrientedBox, Truth
from annotator.types.bases import FileRecord
from annotator.types.boxes import FARTHEST_M
from annotator.types.errors import FormatError
from annotator.types.messages import first_problem

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
    track: BoundedTrack | None = None
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
    try:
        entry = BoxEntry.model_validate(value)
    except ValidationError as error:
        raise FormatError(path, first_problem(error, key, number)) from error
    try:
        box = OrientedBox.from_parts(np.array(entry.center), np.array(entry.rotation), np.array(entry.size))
        if entry.corners is not None:
            gaps = np.linalg.norm(np.array(entry.corners)[:, None] - box_corners(box), axis=2).min(axis=1)
            if gaps.max() > CORNERS_AGREE_M:
                raise ValueError(
                    f"corners differ by up to {gaps.max():.3f} m from center, size and rotation; write rotation row by "
                    "row and size as full lengths"
                )
    except ValueError as error:
        raise FormatError(path, f"frame {key}, {entry.label}: {error}") from error
    return Truth(entry.label, box, entry.track, entry.score, attributes=entry.attributes)
