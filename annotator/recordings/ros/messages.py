"""Messages of bags: decoded by the definitions in the bag, and the clouds and cameras that they describe.

ROS 1, ROS 2 (CDR; both by rosbags), Protobuf and JSON. A decoded message is an object whose attributes are the fields
of its definition, except that all ROS times have `sec` and `nanosec`.

Clouds: `sensor_msgs/PointCloud2`, `foxglove.PointCloud`. Cameras: `sensor_msgs/CameraInfo`,
`foxglove.CameraCalibration`. K, D, R, P, binning and region of interest have the meaning of the comments in
`sensor_msgs/CameraInfo.msg`, and image and region are related as in `image_geometry::PinholeCameraModel`: K and P are
of the full sensor, of which the image is a region, binned. A rectified image (by its topic's name) has the camera P,
without distortion, turned by R. The right camera of a stereo pair that names the tf frame of the left one is moved by
the baseline in P.

Fisheye images (`equidistant`) are undistorted, because a `Camera` is a pinhole camera. RealSense's inverse
Brown-Conrady model maps distorted to undistorted points; it is replaced by the nearest model of OpenCV's form.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.frame_limits import require_pixels
from annotator.recordings.clouds.columns import RawCloud, from_columns
from annotator.recordings.plausible import are_plausible, is_pinhole, is_rotation, pinhole
from annotator.recordings.ros.bag import Topic, short_type
from annotator.recordings.ros.bag_files import Channel
from annotator.types import Camera
from annotator.types.checks import LATEST_NS
from annotator.types.errors import MissingExtraError
from annotator.types.frame import DISTORTION_LENGTHS

# Enough of a message for its time.
HEAD_BYTES = 32
SECOND = 10**9
# What reading the fields of a message raises if they are missing, or of other types than usual.
FIELD_ERRORS = (ValueError, TypeError, AttributeError, LookupError, ArithmeticError)


def decode(channel: Channel, data: bytes) -> Any:
    try:
        return _decoder(channel.encoding, channel.type, channel.schema_encoding, channel.schema)(data)
    except MissingExtraError:
        raise
    # for damaged messages and definitions, the libraries raise any exception
    except Exception as error:
        raise ValueError(f"is not a {short_type(channel.type)} ({str(error)[:120]})") from error


def message(topic: Topic, i: int) -> Any:
    channel, data = topic.read(i)
    return decode(channel, data)


def stamp_ns(content: Any) -> int:
    """Returns the time in a message's header, nanoseconds; 0 = not set."""
    time = content.header.stamp if hasattr(content, "header") else content.timestamp
    # ROS, protobuf, JSON
    names = (("sec", "nanosec"), ("seconds", "nanos"), ("sec", "nsec"))
    sec, nanosec = next(pair for pair in names if hasattr(time, pair[1]) or pair is names[-1])
    stamp = int(getattr(time, sec)) * SECOND + int(getattr(time, nanosec))
    if not 0 <= stamp <= LATEST_NS:
        raise ValueError(f"has the impossible time {stamp} ns")
    return stamp


def frame_id(content: Any) -> str:
    """Returns the tf frame of a message, without a slash before it."""
    name = content.header.frame_id if hasattr(content, "header") else content.frame_id
    return str(name).lstrip("/")


def quick_stamp_ns(topic: Topic, i: int) -> int | None:
    """Returns the time in the header of message `i`, of a type that begins with it; None if it is damaged."""
    try:
        channel, data = topic.read(i, HEAD_BYTES)
        if channel.encoding not in ("ros1", "cdr"):
            return stamp_ns(message(topic, i))
        # CDR says its byte order first; a header of ROS 1 begins with a number
        at = 4 if channel.encoding == "cdr" or not channel.type.startswith("foxglove") else 0
        form = "<II" if channel.encoding == "ros1" else "<iI" if data[1] & 1 else ">iI"
        sec, nanosec = struct.unpack_from(form, data, at)
        return int(sec) * SECOND + int(nanosec)
    except (*FIELD_ERRORS, OSError, struct.error):
        return None


@lru_cache(maxsize=256)
def _decoder(encoding: str, kind: str, schema_encoding: str, schema: bytes) -> Callable[[bytes], Any]:
    if encoding == "json":
        return lambda data: json.loads(data, object_hook=lambda values: SimpleNamespace(**values))
    if encoding == "protobuf":
        return _protobuf_decoder(kind, schema)
    if encoding not in ("ros1", "cdr"):
        raise ValueError(f"has the unknown encoding {encoding!r}; known are ros1, cdr, protobuf and json")
    store, name = _typestore(kind, schema_encoding, schema), _ros2_type(kind)
    method = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    return lambda data: method(data, name)


def _ros2_type(kind: str) -> str:
    package, _, name = short_type(kind).partition("/")
    package = "foxglove_msgs" if package == "foxglove" else package
    return f"{package}/msg/{name}"


def _typestore(kind: str, schema_encoding: str, schema: bytes) -> Any:
    try:
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    except ImportError as error:
        raise MissingExtraError("rosbags", "ros") from error
    if not schema:
        # bags of ROS 2 before Iron have no definitions
        return get_typestore(Stores.ROS2_HUMBLE)
    text = schema.decode("utf-8", "replace")
    store = get_typestore(Stores.EMPTY)
    if schema_encoding in ("ros1msg", "ros2msg"):
        types = get_types_from_msg(text, _ros2_type(kind))
    elif schema_encoding in ("ros2idl", "omgidl"):
        types = {}
        for part in text.split("=" * 80 + "\n"):
            types.update(get_types_from_idl(part.partition("\n")[2] if part.startswith("IDL: ") else part))
    else:
        raise ValueError(f"has a definition of the unknown kind {schema_encoding!r}")
    store.register(types)
    return store


def _protobuf_decoder(kind: str, schema: bytes) -> Callable[[bytes], Any]:
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    except ImportError as error:
        raise MissingExtraError("protobuf", "ros") from error
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    parse: Callable[[bytes], Any] = message_factory.GetMessageClass(pool.FindMessageTypeByName(kind)).FromString
    return parse


def byte_array(data: Any) -> np.ndarray:
    """Returns the bytes of a field: an array, bytes, base64 text (JSON) or a list of numbers."""
    if isinstance(data, str):
        try:
            data = base64.b64decode(data, validate=True)
        except binascii.Error as error:
            raise ValueError("its data are not base64") from error
    if isinstance(data, bytes | bytearray | memoryview):
        return np.frombuffer(data, np.uint8)
    return np.asarray(data).view(np.uint8) if isinstance(data, np.ndarray) else np.array(data, np.uint8)


# sensor_msgs/PointField.msg and foxglove.PackedElementField.NumericType
ROS_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
FOXGLOVE_TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}


def cloud_of(content: Any) -> RawCloud:
    """Returns the cloud of a decoded message, in the frame that it names."""
    data = byte_array(content.data)
    if hasattr(content, "point_stride"):
        size, order = int(content.point_stride), "<"
        fields = [(field, FOXGLOVE_TYPES.get(int(field.type)), 1) for field in content.fields]
        width, height, row = len(data) // max(size, 1), 1, 0
    else:
        size, order = int(content.point_step), ">" if content.is_bigendian else "<"
        fields = [(field, ROS_TYPES.get(int(field.datatype)), int(field.count)) for field in content.fields]
        width, height, row = int(content.width), int(content.height), int(content.row_step)
    row = row or width * size
    end = row * (height - 1) + width * size if width * height else 0
    if row < width * size or end > len(data):
        raise ValueError(
            f"declares {width} x {height} points of {size} bytes in rows of {row} bytes, but has {len(data)} bytes"
        )
    points = np.ndarray((height, width), _point_type(size, order, fields), data, 0, (row, size)).reshape(-1)
    names = points.dtype.names or ()
    raw = from_columns({name: points[name].astype(points.dtype[name].newbyteorder("=")) for name in names})
    pose = getattr(content, "pose", None)
    if pose is None:
        return raw
    turn = [float(getattr(pose.orientation, name)) for name in "xyzw"]
    place = [float(getattr(pose.position, name)) for name in "xyz"]
    # not set: no turn
    T = RigidTransform.from_components(place, Rotation.from_quat(turn if any(turn) else [0.0, 0.0, 0.0, 1.0]))
    return replace(raw, xyz_m=T.apply(raw.xyz_m))


def _point_type(size: int, order: str, fields: list[tuple[Any, str | None, int]]) -> np.dtype:
    """Returns the type of a point, without fields of an unknown type or of several values."""
    if size <= 0:
        raise ValueError(f"declares {len(fields)} fields in points of {size} bytes")
    used: dict[str, tuple[str, int]] = {}
    for field, kind, count in fields:
        name, offset = str(field.name), int(field.offset)
        if kind is None or count > 1:
            continue
        if offset < 0 or offset + np.dtype(kind).itemsize > size:
            raise ValueError(f"has a field {name} at byte {offset}, outside of a point of {size} bytes")
        used.setdefault(name.lower(), (order + kind, offset))
    kinds, offsets = [kind for kind, _ in used.values()], [offset for _, offset in used.values()]
    return np.dtype({"names": list(used), "formats": kinds, "offsets": offsets, "itemsize": size})


RECTIFIED = re.compile(r"rect(?!angle)", re.IGNORECASE)
FISHEYE = ("equidistant", "fisheye", "kannala_brandt4")
MOST_OFF_ROTATION = 1e-3
# Points per side of the grid on which the inverse distortion is fitted.
GRID = 25


@dataclass(frozen=True, eq=False)
class BagCamera:
    """A calibrated camera of a bag, as its images are given to annotator.

    `T_camera_frame` is rectification and baseline, from the tf frame that the calibration names. `fisheye` has K and D
    of the images in the bag, if they must be undistorted.
    """

    camera: Camera
    T_camera_frame: RigidTransform
    fisheye: tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "4"]] | None = None

    def picture(self, rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        import cv2

        self.require_size(rgb.shape)
        if self.fisheye is None:
            return rgb
        K, D = self.fisheye
        size = (self.camera.width_px, self.camera.height_px)
        maps = cv2.fisheye.initUndistortRectifyMap(K, D, np.eye(3), self.camera.matrix, size, cv2.CV_32FC1)
        return np.asarray(cv2.remap(rgb, *maps, cv2.INTER_LINEAR))

    def require_size(self, shape: tuple[int, ...]) -> None:
        size = (self.camera.width_px, self.camera.height_px)
        if shape[1::-1] != size:
            raise ValueError(
                f"has {shape[1]} x {shape[0]} pixels, but its camera has {size[0]} x {size[1]}; "
                "name its calibration with --camera-info (of depth images: --depth-info)"
            )


def read_camera_info(content: Any, is_rectified: bool, first: Any = None) -> BagCamera:
    """Returns the camera of a decoded message.

    `is_rectified`: its images are. `first`: calibration of the first camera of a stereo pair, if the second one, this,
    names its tf frame.
    """
    K, P = _field(content, "K", 9), _field(content, "P", 12) if is_rectified else np.zeros(0)
    if not K.any():
        raise ValueError(
            "is not calibrated: K is zero; name another topic with --camera-info (of depth images: --depth-info)"
        )
    is_rectified = bool(P.any())
    matrix, width, height = _region(content, P.reshape(3, 4)[:, :3] if is_rectified else K.reshape(3, 3))
    if not is_pinhole(matrix):
        raise ValueError("is not a pinhole camera: K must be fx 0 cx 0 fy cy 0 0 1")
    require_pixels(width, height)
    T = RigidTransform.identity()
    if is_rectified:
        # P of the second camera is relative to the rectified first one
        R = _field(first or content, "R", 9).reshape(-1, 3)
        if R.any() and not is_rotation(R, MOST_OFF_ROTATION):
            raise ValueError("has an R that is not a rotation")
        if R.any():
            T = RigidTransform.from_rotation(Rotation.from_matrix(R))
        if first is not None:
            T = RigidTransform.from_translation(baseline_m(content)) * T
    D = np.zeros(0) if is_rectified else _field(content, "D")
    if not D.any():
        return BagCamera(pinhole(matrix, width, height), T)
    model = str(content.distortion_model).lower()
    if model in FISHEYE:
        return _undistorted(width, height, matrix, D)
    if "inverse" in model:
        return BagCamera(pinhole(matrix, width, height, _inverted(width, height, matrix, D)), T)
    # longer lists may end with zeros
    length = next((length for length in DISTORTION_LENGTHS if length >= len(D)), None)
    if length is None or model in ("ftheta", "omni", "cata"):
        raise ValueError(
            f"has the distortion {model or 'without a name'} with {len(D)} numbers; known are plumb_bob, "
            "rational_polynomial and equidistant"
        )
    return BagCamera(pinhole(matrix, width, height, (*D.tolist(), *[0.0] * (length - len(D)))), T)


def baseline_m(content: Any) -> Float64[np.ndarray, "3"]:
    """Returns the place of the first camera of a stereo pair in the rectified camera of a message; zero without one."""
    P = _field(content, "P", 12).reshape(-1, 4)
    if not P.any():
        return np.zeros(3)
    if not is_pinhole(P[:, :3]):
        raise ValueError("has a P that is not that of a pinhole camera")
    return np.linalg.solve(P[:, :3], P[:, 3])


def _region(content: Any, full: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Returns K, width and height of the region of interest after binning, as `image_geometry` does."""
    width, height, matrix = int(content.width), int(content.height), full.copy()
    roi = getattr(content, "roi", None)
    if roi is not None and int(roi.width) and int(roi.height):
        width, height = int(roi.width), int(roi.height)
        matrix[:2, 2] -= (int(roi.x_offset), int(roi.y_offset))
    x, y = (max(int(getattr(content, f"binning_{axis}", 1)), 1) for axis in "xy")
    matrix[0] /= x
    matrix[1] /= y
    return matrix, width // x, height // y


def _field(content: Any, name: str, count: int | None = None) -> Float64[np.ndarray, "n"]:
    """Returns a field of `count` numbers, or of none; ROS 2 writes its name in lower case."""
    values = np.array(list(getattr(content, name if hasattr(content, name) else name.lower())), np.float64).reshape(-1)
    if not are_plausible(values) or (count is not None and len(values) not in (0, count)):
        raise ValueError(f"has a {name} that is not {count or 'a list of'} plausible numbers")
    return values


def _undistorted(width: int, height: int, K: np.ndarray, D: np.ndarray) -> BagCamera:
    import cv2

    if len(D) < 4:
        raise ValueError(f"has {len(D)} numbers of distortion; equidistant has four")
    D = D[:4]
    size = (width, height)
    ideal = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(K, D, size, np.eye(3), balance=0.0)
    if not is_pinhole(ideal):
        raise ValueError("has a distortion that cannot be undone")
    return BagCamera(pinhole(ideal, width, height), RigidTransform.identity(), (K, D))


def _inverted(width: int, height: int, K: np.ndarray, D: np.ndarray) -> tuple[float, ...]:
    """Returns k1 k2 p1 p2 k3 that map the undistorted points of an inverse Brown-Conrady model to the distorted ones.

    Both models are linear in their coefficients, so that these are a least-squares solution.
    """
    columns, rows = np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    seen = np.stack([(columns.ravel() - K[0, 2]) / K[0, 0], (rows.ravel() - K[1, 2]) / K[1, 1]], axis=1)
    ideal = seen + (_moves(seen) @ np.concatenate([D, np.zeros(5)])[:5]).reshape(-1, 2)
    solution, *_ = np.linalg.lstsq(_moves(ideal), (seen - ideal).reshape(-1), rcond=None)
    return tuple(solution.tolist())


def _moves(xy: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "m 5"]:
    """Returns by how much each coefficient (k1 k2 p1 p2 k3) moves x and y of normalised points."""
    import cv2

    points = np.c_[xy, np.ones(len(xy))]
    jacobian = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.zeros(5))[1]
    # after rotation, translation, focal lengths and principal point
    return np.asarray(jacobian[:, 10:15])
