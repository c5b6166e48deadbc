"""SUN RGB-D's 3D boxes: VoteNet's `label/KEY.txt`, and a raw scene's `annotation3Dfinal/index.json`.

Both are in the frame "upright depth": x right, y forward, z up, tilt removed. Their boxes are upright.

VoteNet, 13 fields per row (`votenet/sunrgbd/sunrgbd_utils.py`, `SUNObject3d`):

    class xmin ymin width height cx cy cz half_width half_length half_height ox oy

with the length along the orientation (ox, oy). Raw scenes have a polygon of four corners on the ground, X to the right
and Z forward, between the heights Ymin and Ymax, which increase downwards; the orientation points from the polygon's
middle to the middle of its first edge (SUNRGBDtoolbox, `readframeSUNRGBD.m`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import RigidTransform

from annotator.formats.frame_class_names import DatasetNames
from annotator.formats.json_file import read_model
from annotator.formats.reading import finite_number
from annotator.formats.text_folder import text_files, text_rows
from annotator.text import spelled
from annotator.types import OrientedBox, Truth
from annotator.types.boxes import FARTHEST_M
from annotator.types.errors import FormatError

FIELDS = 13
# Tolerance of a polygon's right angles (cosine): corners were drawn by hand.
MOST_SKEW = 0.1
Metres = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)]
Corners = Annotated[tuple[Metres, ...], Field(min_length=4, max_length=4)]


class ScenePolygon(BaseModel):
    """The ground polygon and height range of one object, as stored; metres."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    X: Corners
    Z: Corners
    Ymin: Metres
    Ymax: Metres


class SceneObject(BaseModel):
    """One object; deleted objects have no name or no polygon."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    name: str = ""
    polygon: tuple[ScenePolygon, ...] = ()


class SceneAnnotation(BaseModel):
    """The part of the file that is read."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    objects: tuple[SceneObject | None, ...] = ()


def read_extracted_labels(path: Path, T_camera_label: RigidTransform | None) -> list[Truth]:
    """Returns the objects of one `label/KEY.txt`, in file order; an empty file has none.

    Args:
        path: the file.
        T_camera_label: from upright depth to the camera frame (`Frame.T_camera_label`); None for identity.

    Raises:
        FormatError: the file is missing, or a row is not a valid label; names file and line.
    """
    return [extracted_truth(fields, T_camera_label, path, line) for line, fields in text_rows(path)]


def extracted_truth(fields: list[str], T_camera_label: RigidTransform | None, path: Path, line: int) -> Truth:
    """Returns the object of one row of a `label/KEY.txt`; arguments and errors as in `read_extracted_labels`."""
    return _truth(*_row(path, line, fields), T_camera_label, path, line)


def read_scene_labels(path: Path, T_camera_label: RigidTransform | None) -> list[Truth]:
    """Returns the objects of one `annotation3Dfinal/index.json`, in file order; spaces in names become `_`.

    Arguments and errors as in `read_extracted_labels`.
    """
    content = read_model(path, SceneAnnotation)
    return [
        _truth("_".join(each.name.split()), *_parts(path, each.name, polygon), T_camera_label, path, None)
        for each in content.objects
        if each is not None and each.name.strip()
        for polygon in each.polygon
    ]


def _row(path: Path, line: int, fields: list[str]) -> tuple[str, np.ndarray, np.ndarray, np.ndarray]:
    """Returns class, centre, size (length, width, height) and orientation of one row."""
    if len(fields) != FIELDS:
        raise FormatError(path, f"a label row has {FIELDS} fields, not {len(fields)}", line)
    label, *numbers = fields
    values = np.array([finite_number(number, path, line) for number in numbers])
    if not (np.abs(values) <= FARTHEST_M).all():
        raise FormatError(path, f"a number is larger than {FARTHEST_M:g}", line)
    half_width, half_length, half_height = values[7:10]
    return label, values[4:7], 2 * np.array([half_length, half_width, half_height]), values[10:12]


def _parts(path: Path, name: str, polygon: ScenePolygon) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns centre, size and orientation of a polygon's box."""
    corners = np.stack([polygon.X, polygon.Z], axis=1)
    across = (corners[1] - corners[0] + corners[2] - corners[3]) / 2
    back = (corners[2] - corners[1] + corners[3] - corners[0]) / 2
    width, length = math.hypot(*across), math.hypot(*back)
    if not width > 0 or not length > 0 or abs(across @ back) > MOST_SKEW * width * length:
        raise FormatError(path, f"the polygon of {name!r} is not a rectangle: {corners.round(3).tolist()}")
    center = np.array([*corners.mean(axis=0), -(polygon.Ymin + polygon.Ymax) / 2])
    return center, np.array([length, width, abs(polygon.Ymax - polygon.Ymin)]), -back


def _truth(
    label: str,
    center_m: np.ndarray,
    size_m: np.ndarray,
    orientation: np.ndarray,
    T_camera_label: RigidTransform | None,
    path: Path,
    line: int | None,
) -> Truth:
    norm = math.hypot(*orientation)
    if norm == 0:
        raise FormatError(path, f"the orientation of {label!r} has length 0", line)
    x, y = orientation / norm
    try:
        box = OrientedBox.from_parts(center_m, np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]]), size_m)
        return Truth(label, box if T_camera_label is None else box.transformed(T_camera_label))
    except ValueError as error:
        raise FormatError(path, f"{label}: {error}", line) from error


@dataclass(frozen=True)
class ExtractedFrame:
    """The labels of one frame.

    Attributes:
        truths: the objects, in upright depth.
        calibration: the path of the frame's calibration, which may be missing; None for labels in an archive.
    """

    truths: tuple[Truth, ...]
    calibration: Path | None


def read_extracted_folder(path: Path) -> dict[str, ExtractedFrame]:
    """Returns the labelled frames, by `RECORDING/KEY` from frames.csv, else by the label file's stem.

    Args:
        path: a folder in VoteNet's layout, its folder `label`, or a zip archive of that.

    Raises:
        FormatError: there are no labels, a row is not a valid label (names the line), or frames.csv does not list a
            label file.
    """
    place = path / "label" if (path / "label").is_dir() else path
    if place == path and (path / "image").is_dir():
        raise FormatError(
            path,
            "has images and no folder label/, so there are no labels to import; extract them with VoteNet's script, or "
            "give SUN RGB-D's table SUNRGBDMeta3DBB_v2.mat instead",
        )
    dataset_names = DatasetNames.of(place)
    frames = {}
    for stem, file, text in text_files(place):
        lines = ((line, row.split()) for line, row in enumerate(text.splitlines(), 1) if row.strip())
        truths = [extracted_truth(fields, None, file, line) for line, fields in lines]
        named = tuple(replace(truth, label=dataset_names.label(truth.label)) for truth in truths)
        calibration = spelled(place.parent / "calib", f"{stem}.txt") if place.is_dir() else None
        frames[dataset_names.frame(stem)] = ExtractedFrame(named, calibration)
    return frames
