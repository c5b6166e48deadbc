"""SUN RGB-D: VoteNet's folder layout with the data set's own label table beside it, and the labels of raw scenes.

    image/ID.jpg  calib/ID.txt  depth/ID.mat  label/ID.txt  PART_data_idx.txt  SUNRGBDMeta3DBB_v2.mat  frames.csv

Clouds (`instance`: n x 6 float32, x y z metres, r g b in 0..1) and labels are in the frame "upright depth": x right, y
forward, z up, tilt removed (`sunrgbd_table.py`). Boxes of labels are upright. A label row has 13 fields
(`votenet/sunrgbd/sunrgbd_utils.py`, `SUNObject3d`)

    class xmin ymin width height cx cy cz half_width half_length half_height ox oy

with pixels counted from 1 and the length along the orientation (ox, oy). A calib file has `Rtilt` and `K` on one line
each, column by column. IDs have six digits; index lists store them as numbers.

Raw scenes (`annotation3Dfinal/index.json`) have a polygon of four corners on the ground, X to the right and Z forward,
between the heights Ymin and Ymax, which increase downwards; the orientation points from the polygon's middle to the
middle of its first edge (SUNRGBDtoolbox, `readframeSUNRGBD.m`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float32
from pydantic import Field
from scipy.spatial.transform import RigidTransform

from annotator.formats.dataset_writing import DatasetItem, DatasetWriter, encoded_image
from annotator.formats.frame_names import ClassWords, DatasetNames, six_digit_ids
from annotator.formats.json_file import FileRecord, read_model
from annotator.formats.losses import Lost
from annotator.formats.reading import finite_number, text_files, text_rows
from annotator.formats.sunrgbd_table import (
    FIRST_PX,
    META,
    MetaRow,
    dump_meta,
    meta_frame,
    one_based_matrix,
    tilt_matrix,
    upright_frame,
)
from annotator.geometry.oriented_box import nearest_upright
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import project, straightened
from annotator.text import spelled
from annotator.types import Box2D, Camera, Frame, OrientedBox, Truth
from annotator.types.boxes import FARTHEST_M
from annotator.types.errors import FormatError

PARTS = ("image", "calib", "depth", "label")
INDEX = "{}_data_idx.txt"
# The data set numbers its frames from 1.
FIRST_ID = 1
UP = np.array([0.0, 0.0, 1.0])
# Minimum side of a 2D box, pixels; objects that are narrower on the image are left out.
LEAST_SIDE_PX = 0.01
LEAST_HALF_M = 1e-6


class SunRgbdWriter(DatasetWriter):
    """Has the labels of all frames in memory. Parts may have any name. Only the table stores tilted boxes."""

    def begin(self) -> None:
        self._words = ClassWords(self.info.classes)
        self._ids = six_digit_ids([(recording, key) for recording, key, _ in self.info.places], FIRST_ID)
        self._table: list[MetaRow] = []
        for name in PARTS:
            (self.folder / name).mkdir()

    def frame_id(self, item: DatasetItem) -> str:
        return self._ids[item.recording, item.frame.key]

    def frame(self, item: DatasetItem, frame_id: str) -> None:
        from scipy.io import savemat

        frame, losses = item.frame, self.losses
        camera, rgb = straightened(frame.camera, frame.rgb)
        T = upright_frame(frame)
        (self.folder / "image" / f"{frame_id}.jpg").write_bytes(encoded_image(rgb, "jpg"))
        (self.folder / "calib" / f"{frame_id}.txt").write_text(calibration_text(camera, T), encoding="utf-8")
        # compressed as in the data set, which halves the size
        points = upright_points(frame, T, camera, rgb)
        savemat(str(self.folder / "depth" / f"{frame_id}.mat"), {"instance": points}, do_compression=True)
        rows, boxes = [], []
        for label in item.labels:
            box = label.box.transformed(T.inv())
            upright, tilt_rad = nearest_upright(box, UP)
            on_image = box_on_image(camera, upright.transformed(T), label.label, LEAST_SIDE_PX)
            if on_image is None:
                losses.add(Lost.OUTSIDE)
                continue
            losses.add_tilt(tilt_rad)
            if self._words.is_changed(label.label):
                losses.add(Lost.NAME)
            self.counts[label.label] += 1
            rows.append(dump_label_row(self._words[label.label], upright, on_image) + "\n")
            boxes.append((label.label, box, on_image))
        (self.folder / "label" / f"{frame_id}.txt").write_text("".join(rows), encoding="utf-8")
        files = (f"depth/{frame_id}.mat", f"image/{frame_id}.jpg")
        self._table.append(meta_frame(self.origins[-1].name, files, camera, T, boxes))

    def finish(self) -> None:
        """Writes the table, and the frame numbers of each part, one per line; without parts all are in train."""
        from scipy.io import savemat

        savemat(str(self.folder / META), dump_meta(self._table), do_compression=True)
        parts: dict[str, list[str]] = {}
        for origin in self.origins:
            parts.setdefault(origin.split or "train", []).append(f"{int(origin.id)}\n")
        for name, numbers in parts.items():
            (self.folder / INDEX.format(name)).write_text("".join(numbers), encoding="utf-8")
        self._words.write(self.folder)


def dump_label_row(label: str, box: OrientedBox, on_image: Box2D) -> str:
    """Returns a label row, which `labels.extracted_truth` reads.

    Args:
        label: one word.
        box: in upright depth, z up.
        on_image: its 2D box, pixels counted from 0.
    """
    length, width, height = np.maximum(box.size_m / 2, LEAST_HALF_M)
    corner = (on_image.x_min + FIRST_PX, on_image.y_min + FIRST_PX)
    numbers = (*corner, on_image.width_px, on_image.height_px, *box.center_m, width, length, height)
    # more digits: the heading is normalised when read, and must not rotate with each round trip
    heading = box.rotation[:2, 0]
    return " ".join([label, *(_decimal(value, 6) for value in numbers), *(_decimal(value, 9) for value in heading)])


def _decimal(value: float, digits: int) -> str:
    # no "-0.000000", so that reading and writing a file leaves it unchanged
    return f"{round(float(value), digits) + 0.0:.{digits}f}"


def calibration_text(camera: Camera, T_camera_upright: RigidTransform) -> str:
    """Returns the text of `calib/ID.txt` for an ideal camera."""
    matrices = (tilt_matrix(T_camera_upright), one_based_matrix(camera))
    return "".join(" ".join(f"{value:.12g}" for value in matrix.T.ravel()) + "\n" for matrix in matrices)


def upright_points(
    frame: Frame, T_camera_upright: RigidTransform, camera: Camera, rgb: np.ndarray
) -> Float32[np.ndarray, "n 6"]:
    """Returns `instance` of a frame: points in upright depth and their colours.

    Clouds without colours get those of the image; points outside the image are black.

    Args:
        camera, rgb: the ideal camera and its image.
    """
    xyz = T_camera_upright.inv().apply(frame.cloud.xyz_m.astype(np.float64))
    colors = frame.cloud.rgb
    if colors is None:
        px = np.nan_to_num(np.rint(project(camera, frame.cloud.xyz_m)), nan=-1.0)
        inside = ((px >= 0) & (px < [camera.width_px, camera.height_px])).all(axis=1)
        colors = np.zeros((len(xyz), 3), np.uint8)
        u, v = px[inside].astype(np.int64).T
        colors[inside] = rgb[v, u]
    return np.column_stack([xyz, colors / 255.0]).astype(np.float32)


FIELDS = 13
# Tolerance of a polygon's right angles (cosine): corners were drawn by hand.
MOST_SKEW = 0.1
Metres = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)]
Corners = Annotated[tuple[Metres, ...], Field(min_length=4, max_length=4)]


class ScenePolygon(FileRecord):
    """The ground polygon and height range of one object, as stored; metres."""

    X: Corners
    Z: Corners
    Ymin: Metres
    Ymax: Metres


class SceneObject(FileRecord):
    """One object; deleted objects have no name or no polygon."""

    name: str = ""
    polygon: tuple[ScenePolygon, ...] = ()


class SceneAnnotation(FileRecord):
    """The part of the file that is read."""

    objects: tuple[SceneObject | None, ...] = ()


def read_extracted_labels(path: Path, T_camera_label: RigidTransform | None) -> list[Truth]:
    """Returns the objects of one `label/KEY.txt`, in file order; an empty file has none.

    Args:
        T_camera_label: from upright depth to the camera frame (`Frame.T_camera_label`); None for identity.
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
