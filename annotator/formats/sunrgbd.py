"""SUN RGB-D: VoteNet's folder layout with the data set's own label table beside it, and the labels of raw scenes.

    image/ID.jpg  calib/ID.txt  depth/ID.mat  label/ID.txt  PART_data_idx.txt  SUNRGBDMeta3DBB_v2.mat  frames.csv

Clouds (`instance`: n x 6 float32, x y z metres, r g b in 0..1) and labels are in the frame "upright depth": x right, y
forward, z up, tilt removed. Boxes of labels are upright. A label row has 13 fields
(`votenet/sunrgbd/sunrgbd_utils.py`, `SUNObject3d`)

    class xmin ymin width height cx cy cz half_width half_length half_height ox oy

with pixels counted from 1 and the length along the orientation (ox, oy). A calib file has `Rtilt` and `K` on one line
each, column by column. IDs have six digits; index lists store them as numbers.

Raw scenes (`annotation3Dfinal/index.json`) have a polygon of four corners on the ground, X to the right and Z forward,
between the heights Ymin and Ymax, which increase downwards; the orientation points from the polygon's middle to the
middle of its first edge (SUNRGBDtoolbox, `readframeSUNRGBD.m`).

The data set's own table, `SUNRGBDMeta3DBB_v2.mat`, has boxes with all three axes, so they may be tilted.

A struct array `SUNRGBDMeta`, one element per frame (SUNRGBDtoolbox, `readframeSUNRGBD.m`; labels of version 2), with

    sequenceName Rtilt K depthpath rgbpath anno_extrinsics depthname rgbname sensorType valid groundtruth3DBB

in this order, and in groundtruth3DBB, one element per object,

    basis coeffs centroid classname sequenceName orientation label  gtBb2D

of which the last, the 2D box x y width height, is only in the first version of the labels. Everything is in upright
depth, metres, pixels counted from 1. The rows of `basis` are the box's axes and `coeffs` its half
sizes along them (`get_corners_of_bb3d.m`): across (to the right), along the heading, and up, as VoteNet reads them.

"Upright depth" is x right, y forward, z up, origin at the camera. Recordings of SUN RGB-D have their own transform. For
others it follows from gravity: y is the levelled viewing direction. A camera's point is mapped by `Rtilt * [X, Z, -Y]`
(SUNRGBDtoolbox, `read3dPoints.m`).
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float32, Float64
from pydantic import BeforeValidator, Field, StringConstraints
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.fenced_files import read_mat
from annotator.formats.dataset_writing import DatasetItem, DatasetWriter, Lost
from annotator.formats.frame_names import ClassWords, DatasetNames, LabelledFrame, six_digit_ids
from annotator.formats.reading import (
    MAX_BYTES,
    faults,
    finite_number,
    read_model,
    rotation_problem,
    text_files,
    text_rows,
)
from annotator.geometry.oriented_box import nearest_upright
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import project, straightened
from annotator.geometry.transforms import level_pose
from annotator.image_bytes import encoded_image
from annotator.text import spelled
from annotator.types import Box2D, Camera, Frame, OrientedBox, Truth
from annotator.types.bases import FileRecord
from annotator.types.boxes import FARTHEST_M
from annotator.types.errors import FormatError

# [X, Z, -Y] of a camera's point [X, Y, Z].
SWAPPED = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
# The level frame at the camera has x ahead and y to the left.
LEVEL_UPRIGHT = RigidTransform.from_rotation(
    Rotation.from_matrix(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
)
# SUN RGB-D counts pixels from 1.
FIRST_PX = 1.0
# Tolerance for an up axis equal to gravity, and for a zero translation.
SAME = 1e-6


def upright_frame(frame: Frame) -> RigidTransform:
    """Returns T_camera_upright of a frame; if gravity is unknown, it is assumed to point down the image."""
    up, T = frame.up, frame.T_camera_label
    if T is not None and up is not None and np.linalg.norm(T.translation) < SAME:
        label_up = T.rotation.apply([0.0, 0.0, 1.0])
        if np.linalg.norm(label_up - up) < SAME:
            return T
    return level_pose(up).inv() * LEVEL_UPRIGHT


def tilt_matrix(T_camera_upright: RigidTransform) -> Float64[np.ndarray, "3 3"]:
    """Returns `Rtilt` of a frame."""
    return np.asarray(T_camera_upright.inv().rotation.as_matrix() @ SWAPPED.T)


def one_based_matrix(camera: Camera) -> Float64[np.ndarray, "3 3"]:
    """Returns `K` of a camera, pixels counted from 1."""
    return camera.matrix + np.array([[0.0, 0.0, FIRST_PX], [0.0, 0.0, FIRST_PX], [0.0, 0.0, 0.0]])


META = "SUNRGBDMeta3DBB_v2.mat"
VARIABLE = "SUNRGBDMeta"
FRAME_FIELDS = (
    *("sequenceName", "Rtilt", "K", "depthpath", "rgbpath", "anno_extrinsics", "depthname", "rgbname"),
    *("sensorType", "valid", "groundtruth3DBB"),
)
BOX_FIELDS = ("basis", "coeffs", "centroid", "classname", "sequenceName", "orientation", "label", "gtBb2D")
# The data set's paths begin with ROOT; the rest, joined by KEY_SEPARATOR, is a frame's key in recordings of its scenes.
ROOT, KEY_SEPARATOR = "SUNRGBD/", "__"

MetaRow = tuple[Any, ...]
Metres = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)]


def _as_list(value: object) -> object:
    """An array as the list of its values; an empty struct array is an empty one of any type."""
    return value.ravel().tolist() if isinstance(value, np.ndarray) else value


Three = Annotated[list[Metres], BeforeValidator(_as_list), Field(min_length=3, max_length=3)]
Nine = Annotated[list[Metres], BeforeValidator(_as_list), Field(min_length=9, max_length=9)]
Name = Annotated[str, StringConstraints(pattern=r"\S")]


class TableObject(FileRecord):
    """An element of `groundtruth3DBB`."""

    classname: Name
    basis: Nine
    coeffs: Three
    centroid: Three
    orientation: Three | None = None


class TableFrame(FileRecord):
    """An element of the table."""

    sequenceName: Name
    Rtilt: Nine
    groundtruth3DBB: Annotated[list[TableObject], BeforeValidator(_as_list)]


def meta_frame(
    name: str,
    files: tuple[str, str],
    camera: Camera,
    T_camera_upright: RigidTransform,
    boxes: Sequence[tuple[str, OrientedBox, Box2D]],
) -> MetaRow:
    """Returns one element of the struct array, its fields in order.

    Args:
        name: `RECORDING/KEY`.
        files: paths of the cloud and the image within the dataset.
        camera: an ideal camera.
        boxes: class, box in upright depth, and 2D box of each object.
    """
    depth, image = files
    Rtilt = tilt_matrix(T_camera_upright)
    objects = _struct(BOX_FIELDS, [_object(name, *each) for each in boxes])
    # the extrinsics level the camera without swapping its axes
    level = SWAPPED.T @ Rtilt @ SWAPPED
    K = one_based_matrix(camera)
    return name, Rtilt, K, depth, image, level, Path(depth).name, Path(image).name, "annotator", 1.0, objects


def dump_meta(frames: Sequence[MetaRow]) -> dict[str, np.ndarray]:
    """Returns the content of the file for `scipy.io.savemat`."""
    return {VARIABLE: _struct(FRAME_FIELDS, frames)}


def _struct(fields: Sequence[str], rows: Sequence[tuple[Any, ...]]) -> np.ndarray:
    """A struct array."""
    table = np.empty((1, len(rows)), [(field, object) for field in fields])
    for number, row in enumerate(rows):
        table[0, number] = row
    return table


def read_meta(path: Path) -> dict[str, LabelledFrame]:
    """Returns the frames of a `SUNRGBDMeta*.mat`, by `RECORDING/KEY`, or a scene's path in the data set joined by
    `KEY_SEPARATOR`.
    """
    with faults(path, remedy="; copy the file again"):
        table = read_mat(path, VARIABLE, MAX_BYTES)
    frames: dict[str, LabelledFrame] = {}
    for number, each in enumerate(table if isinstance(table, list) else [table], 1):
        with faults(path, f"frame {number}: "):
            content = TableFrame.model_validate(each)
        name, frame = _frame(path, f"frame {number}", content)
        if name in frames:
            raise FormatError(path, f"the frame {name} occurs twice; keep one of its elements")
        frames[name] = frame
    return frames


def _object(name: str, label: str, box: OrientedBox, on_image: Box2D) -> tuple[Any, ...]:
    length, width, height = box.size_m
    along, across, up = box.rotation.T
    basis = np.stack([-across, along, up])
    coeffs = np.array([[width, length, height]]) / 2
    corner = [on_image.x_min + FIRST_PX, on_image.y_min + FIRST_PX]
    bb2d = np.array([[*corner, on_image.width_px, on_image.height_px]])
    return basis, coeffs, box.center_m[None], label, name, along[None], 1.0, bb2d


def _frame(path: Path, where: str, content: TableFrame) -> tuple[str, LabelledFrame]:
    Rtilt = np.array(content.Rtilt).reshape(3, 3)
    T = RigidTransform.from_rotation(Rotation.from_matrix(_rotation(path, f"{where}, Rtilt", Rtilt @ SWAPPED).T))
    objects = enumerate(content.groundtruth3DBB, 1)
    truths = [_table_truth(path, f"{where}, object {number}", each) for number, each in objects]
    return _key(content.sequenceName), LabelledFrame(truths, T)


def _key(name: str) -> str:
    return name.removeprefix(ROOT).strip("/").replace("/", KEY_SEPARATOR) if name.startswith(ROOT) else name


def _table_truth(path: Path, where: str, entry: TableObject) -> Truth:
    across, along, up = np.array(entry.basis).reshape(3, 3)
    width, length, height = 2 * np.abs(entry.coeffs)
    if entry.orientation is not None:
        facing = np.array(entry.orientation)
        # in other tables the first two rows may be in either order; the heading is the one nearest to orientation
        if abs(across @ facing) > abs(along @ facing):
            across, along, width, length = along, across, length, width
        along = along if along @ facing >= 0 else -along
    left = -across if np.linalg.det(np.stack([along, -across, up])) > 0 else across
    R = _rotation(path, f"{where}, basis", np.stack([along, left, up], axis=1))
    with faults(path, f"{where}: "):
        box = OrientedBox.from_parts(np.array(entry.centroid), R, np.array([length, width, height]))
        return Truth(entry.classname, box)


def _rotation(path: Path, where: str, R: np.ndarray) -> np.ndarray:
    """Returns the nearest rotation; raises FormatError if `R` deviates from one by more than `MOST_SKEW`."""
    if (problem := rotation_problem(R, MOST_SKEW)) is not None:
        raise FormatError(path, f"{where} {problem}")
    U, _, V = np.linalg.svd(R)
    return np.asarray(U @ V)


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

    def frame_id(self, item: DatasetItem) -> str:
        return self._ids[item.recording, item.frame.key]

    def frame(self, item: DatasetItem, frame_id: str) -> None:
        frame, losses = item.frame, self.losses
        camera, rgb = straightened(frame.camera, frame.rgb)
        T = upright_frame(frame)
        files = (f"depth/{frame_id}.mat", f"image/{frame_id}.jpg")
        self.put(files[1], encoded_image(rgb, "jpg"))
        self.put(f"calib/{frame_id}.txt", calibration_text(camera, T))
        # compressed as in the data set, which halves the size
        points = upright_points(frame, T, camera, rgb)
        self.put_mat(files[0], {"instance": points})
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
        self.put(f"label/{frame_id}.txt", "".join(rows))
        self._table.append(meta_frame(self.origins[-1].name, files, camera, T, boxes))

    def put_mat(self, name: str, content: dict[str, np.ndarray]) -> None:
        """Writes a MATLAB file."""
        from scipy.io import savemat

        savemat(stream := io.BytesIO(), content, do_compression=True)
        self.put(name, stream.getvalue())

    def finish(self) -> None:
        """Writes the table, and the frame numbers of each part, one per line; without parts all are in train."""
        self.put_mat(META, dump_meta(self._table))
        for name, ids in self.parts("train").items():
            self.put(INDEX.format(name), "".join(f"{int(each)}\n" for each in ids))
        self._words.write(self.folder)


def dump_label_row(label: str, box: OrientedBox, on_image: Box2D) -> str:
    """Returns a label row, which `extracted_truth` reads.

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


def read_extracted_labels(path: Path, T_camera_label: RigidTransform | None, text: str | None = None) -> list[Truth]:
    """Returns the objects of one `label/KEY.txt`, in file order; an empty file has none.

    Args:
        T_camera_label: from upright depth to the camera frame (`Frame.T_camera_label`); None for identity.
        text: the content of the file; None: it is read.
    """
    return [extracted_truth(fields, T_camera_label, path, line) for line, fields in text_rows(path, text)]


def extracted_truth(fields: list[str], T_camera_label: RigidTransform | None, path: Path, line: int) -> Truth:
    """Returns the object of one row of a `label/KEY.txt`; arguments and errors as in `read_extracted_labels`."""
    if len(fields) != FIELDS:
        raise FormatError(path, f"a label row has {FIELDS} fields, not {len(fields)}", line)
    label, *numbers = fields
    values = np.array([finite_number(number, path, line) for number in numbers])
    if not (np.abs(values) <= FARTHEST_M).all():
        raise FormatError(path, f"a number is larger than {FARTHEST_M:g}", line)
    # the file has half the width, length and height
    return _truth(label, values[4:7], 2 * values[[8, 7, 9]], values[10:12], T_camera_label, path, line)


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
    with faults(path, f"{label}: ", line):
        box = OrientedBox.from_parts(center_m, np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]]), size_m)
        return Truth(label, box if T_camera_label is None else box.transformed(T_camera_label))


def read_extracted_folder(path: Path, read_pose: Callable[[Path], RigidTransform]) -> dict[str, LabelledFrame]:
    """Returns the labelled frames, by `RECORDING/KEY` from frames.csv, else by the label file's stem.

    Args:
        path: a folder in VoteNet's layout, its folder `label`, or a zip archive of that.
        read_pose: reads T_camera_upright from a frame's calibration; without one it follows from the frame.
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
        truths = read_extracted_labels(file, None, text)
        named = tuple(replace(truth, label=dataset_names.label(truth.label)) for truth in truths)
        calibration = spelled(place.parent / "calib", f"{stem}.txt")
        pose = read_pose(calibration) if place.is_dir() and calibration.is_file() else upright_frame
        frames[dataset_names.frame(stem)] = LabelledFrame(named, pose)
    return frames
