"""SUN RGB-D's own label table, `SUNRGBDMeta3DBB_v2.mat`: boxes with all three axes, so they may be tilted.

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

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.units import rotation_problem
from annotator.geometry.transforms import level_pose
from annotator.mat_file import MatFileError, read_mat
from annotator.types import Box2D, Camera, Frame, OrientedBox, Truth
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
# Tolerance of right angles between axes (cosine).
MOST_SKEW = 0.1
# The data set's own table, with some ten thousand frames, is smaller.
MAX_BYTES = 2**28

MetaRow = tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class MetaFrame:
    """One frame of the table.

    Attributes:
        name: `RECORDING/KEY`, or a scene's path in the data set joined by `KEY_SEPARATOR`.
        T_camera_upright: from upright depth to the camera.
        truths: the objects, in upright depth.
    """

    name: str
    T_camera_upright: RigidTransform
    truths: tuple[Truth, ...]


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
    objects = np.empty((1, len(boxes)), [(field, object) for field in BOX_FIELDS])
    for number, (label, box, on_image) in enumerate(boxes):
        objects[0, number] = _object(name, label, box, on_image)
    # the extrinsics level the camera without swapping its axes
    level = SWAPPED.T @ Rtilt @ SWAPPED
    K = one_based_matrix(camera)
    return name, Rtilt, K, depth, image, level, Path(depth).name, Path(image).name, "annotator", 1.0, objects


def dump_meta(frames: Sequence[MetaRow]) -> dict[str, np.ndarray]:
    """Returns the content of the file for `scipy.io.savemat`."""
    table = np.empty((1, len(frames)), [(field, object) for field in FRAME_FIELDS])
    for number, frame in enumerate(frames):
        table[0, number] = frame
    return {VARIABLE: table}


def read_meta(path: Path) -> list[MetaFrame]:
    """Returns the frames of a `SUNRGBDMeta*.mat`."""
    try:
        table = read_mat(path, VARIABLE, MAX_BYTES)
    except MatFileError as error:
        raise FormatError(path, f"{error}; copy the file again") from error
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    frames = [_frame(path, f"frame {n}", each) for n, each in enumerate(_records(path, VARIABLE, table), 1)]
    names = [frame.name for frame in frames]
    if len(set(names)) < len(names):
        repeated = next(name for number, name in enumerate(names) if name in names[:number])
        raise FormatError(path, f"the frame {repeated} occurs twice; keep one of its elements")
    return frames


def _object(name: str, label: str, box: OrientedBox, on_image: Box2D) -> tuple[Any, ...]:
    length, width, height = box.size_m
    along, across, up = box.rotation.T
    basis = np.stack([-across, along, up])
    coeffs = np.array([[width, length, height]]) / 2
    corner = [on_image.x_min + FIRST_PX, on_image.y_min + FIRST_PX]
    bb2d = np.array([[*corner, on_image.width_px, on_image.height_px]])
    return basis, coeffs, box.center_m[None], label, name, along[None], 1.0, bb2d


def _records(path: Path, where: str, value: object) -> list[dict[str, Any]]:
    """Returns the elements of a struct array; an empty array of any type has none."""
    if isinstance(value, np.ndarray) and value.size == 0:
        return []
    if not isinstance(value, list) or not all(isinstance(each, dict) for each in value):
        raise FormatError(path, f"{where} is not a struct array")
    return value


def _frame(path: Path, where: str, entry: dict[str, Any]) -> MetaFrame:
    name = _text(path, where, entry, "sequenceName")
    Rtilt = _numbers(path, where, entry, "Rtilt", 9).reshape(3, 3)
    T = RigidTransform.from_rotation(Rotation.from_matrix(_rotation(path, f"{where}, Rtilt", Rtilt @ SWAPPED).T))
    objects = _records(path, f"{where}, groundtruth3DBB", _field(path, where, entry, "groundtruth3DBB"))
    truths = [_truth(path, f"{where}, object {number}", each) for number, each in enumerate(objects, 1)]
    return MetaFrame(_key(name), T, tuple(truths))


def _key(name: str) -> str:
    return name.removeprefix(ROOT).strip("/").replace("/", KEY_SEPARATOR) if name.startswith(ROOT) else name


def _truth(path: Path, where: str, entry: dict[str, Any]) -> Truth:
    label = _text(path, where, entry, "classname")
    across, along, up = _numbers(path, where, entry, "basis", 9).reshape(3, 3)
    width, length, height = 2 * np.abs(_numbers(path, where, entry, "coeffs", 3))
    if "orientation" in entry:
        facing = _numbers(path, where, entry, "orientation", 3)
        # in other tables the first two rows may be in either order; the heading is the one nearest to orientation
        if abs(across @ facing) > abs(along @ facing):
            across, along, width, length = along, across, length, width
        along = along if along @ facing >= 0 else -along
    left = -across if np.linalg.det(np.stack([along, -across, up])) > 0 else across
    R = _rotation(path, f"{where}, basis", np.stack([along, left, up], axis=1))
    center = _numbers(path, where, entry, "centroid", 3)
    try:
        return Truth(label, OrientedBox.from_parts(center, R, np.array([length, width, height])))
    except ValueError as error:
        raise FormatError(path, f"{where}: {error}") from error


def _rotation(path: Path, where: str, R: np.ndarray) -> np.ndarray:
    """Returns the nearest rotation; raises FormatError if `R` deviates from one by more than `MOST_SKEW`."""
    if (problem := rotation_problem(R, MOST_SKEW)) is not None:
        raise FormatError(path, f"{where} {problem}")
    U, _, V = np.linalg.svd(R)
    return np.asarray(U @ V)


def _field(path: Path, where: str, entry: dict[str, Any], name: str) -> Any:
    if name not in entry:
        raise FormatError(path, f"{where} has no field {name}")
    return entry[name]


def _numbers(path: Path, where: str, entry: dict[str, Any], name: str, count: int) -> np.ndarray:
    value = _field(path, where, entry, name)
    if not isinstance(value, np.ndarray) or value.size != count:
        raise FormatError(path, f"{where}, {name} must have {count} numbers")
    numbers = value.astype(np.float64).ravel()
    # no scene is that large, and squares of much larger numbers overflow
    if not (np.abs(numbers) < 1e9).all():
        raise FormatError(path, f"{where}, {name} has a number that is not finite or is larger than 1e9")
    return numbers


def _text(path: Path, where: str, entry: dict[str, Any], name: str) -> str:
    value = _field(path, where, entry, name)
    if not isinstance(value, str) or not value.strip():
        raise FormatError(path, f"{where}, {name} must be text and not empty")
    return value
