"""`boxes.json`: the true oriented boxes of an RGB-D folder, by frame.

    {"000012": {"label": "hand", "center": [x, y, z], "size": [l, w, h], "rotation": [[..], [..], [..]]}, ...}

A frame has one object or a list of them. Metres, camera frame; `rotation` is 3x3, nested rows, its columns the box's
axes; `size` are full lengths along them. Optional: `corners` (8x3, checked against the rest) and `track` (the object's
number over the recording). Other keys are left alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from annotator.formats.json_file import no_twins, read_json
from annotator.geometry.oriented_box import box_corners
from annotator.types import OrientedBox, Truth
from annotator.types.boxes import FARTHEST_M
from annotator.types.errors import FormatError

Number = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)]
Vector = tuple[Number, Number, Number]
# Corners are a second way to say the same; files round their numbers, to millimetres at worst.
CORNERS_AGREE_M = 2e-3


class BoxEntry(BaseModel):
    """One object of one frame, as it is written."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    label: Annotated[str, Field(min_length=1)]
    center: Vector
    size: Vector
    rotation: tuple[Vector, Vector, Vector]
    corners: Annotated[tuple[Vector, ...], Field(min_length=8, max_length=8)] | None = None
    track: int | None = None


def read_boxes(path: Path) -> dict[str, list[Truth]]:
    """The true objects of every frame in the file, by frame key; a frame may have none.

    Raises:
        FormatError: the file is missing or not JSON, or an entry is no box; names the frame.
    """
    return {
        key: [entry_truth(entry, path, key, number) for number, entry in enumerate(entries)]
        for key, entries in read_entries(path).items()
    }


def read_entries(path: Path) -> dict[str, list[object]]:
    """What the file has of every frame, by frame key; whether it is a box is `entry_truth`'s to say.

    Raises:
        FormatError: the file is missing, or is no JSON object.
    """
    content = read_json(path, no_twins)
    if not isinstance(content, dict):
        raise FormatError(path, "must be an object with one entry a frame")
    return {key: value if isinstance(value, list) else [value] for key, value in content.items()}


def entry_truth(value: object, path: Path, key: str, number: int) -> Truth:
    """The object that an entry of a frame is; `number` counts the frame's entries from 0.

    Raises:
        FormatError: it is no box; names the frame.
    """
    try:
        return _truth(BoxEntry.model_validate(value), path, key)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in (key, number, *first["loc"]))
        raise FormatError(path, f"{where}: {first['msg']}") from error


def _truth(entry: BoxEntry, path: Path, key: str) -> Truth:
    try:
        box = OrientedBox.from_parts(np.array(entry.center), np.array(entry.rotation), np.array(entry.size))
    except ValueError as error:
        raise FormatError(path, f"frame {key}, {entry.label}: {error}") from error
    if entry.corners is not None:
        gaps = np.linalg.norm(np.array(entry.corners)[:, None] - box_corners(box), axis=2).min(axis=1)
        if gaps.max() > CORNERS_AGREE_M:
            raise FormatError(
                path,
                f"frame {key}, {entry.label}: corners lie up to {gaps.max():.3f} m off the box of center, size and "
                "rotation; is rotation written row by row, are sizes full lengths?",
            )
    return Truth(entry.label, box, entry.track)
