"""Writes bags with the writer of rosbags, in every container; and a small take of a camera and a LiDAR."""

from __future__ import annotations

import shutil
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import RigidTransform, Rotation

SECOND = 10**9
STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}
# standard in ROS 1, but not among the types of rosbags
STORES[1].register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
TYPE_NUMBERS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


class BagWriter(AbstractContextManager["BagWriter"]):
    """Writes a bag: `ros1` a file, the others a folder; `path` is what a user opens."""

    def __init__(self, folder: Path, container: str, compression: str = "") -> None:
        self.container = container
        self.is_ros1 = container == "ros1"
        self.store = STORES[1 if self.is_ros1 else 2]
        self._topics: dict[str, Any] = {}
        self.writer: Any
        if self.is_ros1:
            self.path = folder / "take.bag"
            self.writer = Writer1(self.path)
            if compression:
                self.writer.set_compression(Writer1.CompressionFormat[compression.upper()])
        else:
            self.path = folder / f"take_{container}"
            shutil.rmtree(self.path, ignore_errors=True)
            plugin = StoragePlugin.MCAP if container == "mcap" else StoragePlugin.SQLITE3
            self.writer = Writer2(self.path, version=9, storage_plugin=plugin)
            if compression:
                self.writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
        self.writer.open()

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def message(self, kind: str, **values: Any) -> Any:
        """A message. Its parts are given as dictionaries; what is not given is zero or empty."""
        name, made = kind if "/msg/" in kind else kind.replace("/", "/msg/"), {}
        for field, (node, detail) in self.store.fielddefs[name][1]:
            # ROS 2 writes the names of matrices in lower case
            given = values.get(field, values.get(field.upper()))
            if node == Nodetype.NAME:
                given = self.message(detail, **(given or {}))
            elif node == Nodetype.BASE:
                given = ("" if detail[0] == "string" else 0) if given is None else given
            elif detail[0][0] == Nodetype.NAME:
                given = [self.message(detail[0][1], **each) for each in given or ()]
            else:
                given = np.asarray(np.zeros(detail[1]) if given is None else given, detail[0][1][0]).ravel()
            made[field] = given
        return self.store.types[name](**made)

    def header(self, time_ns: int, frame: str) -> dict[str, Any]:
        return {"stamp": {"sec": time_ns // SECOND, "nanosec": time_ns % SECOND}, "frame_id": frame}

    def write(self, topic: str, log_ns: int, kind: str, **values: Any) -> None:
        message = self.message(kind, **values)
        kind = message.__msgtype__
        if topic not in self._topics:
            self._topics[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
        self.writer.write(self._topics[topic], log_ns, serialize(message, kind))

    def put(self, topic: str, time_ns: int, kind: str, frame: str, log_ns: int | None = None, **values: Any) -> None:
        """Writes a message with a header."""
        log_ns = time_ns if log_ns is None else log_ns
        self.write(topic, log_ns, f"sensor_msgs/{kind}", header=self.header(time_ns, frame), **values)

    def image(
        self, topic: str, time_ns: int, pixels: np.ndarray, encoding: str, frame: str = "camera", *,
        log_ns: int | None = None, **changed: Any,
    ) -> None:  # fmt: skip
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        fields = {"height": len(pixels), "width": pixels.shape[1], "encoding": encoding, "step": rows.shape[1]}
        self.put(topic, time_ns, "Image", frame, log_ns, **{**fields, "data": rows, **changed})

    def compressed(self, topic: str, time_ns: int, form: str, data: bytes, frame: str = "camera") -> None:
        self.put(topic, time_ns, "CompressedImage", frame, format=form, data=np.frombuffer(data, np.uint8))

    def info(
        self, topic: str, time_ns: int, size: tuple[int, int], K: np.ndarray, frame: str = "camera", *,
        R: np.ndarray | None = None, P: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        R = np.eye(3) if R is None else R
        self.put(
            topic, time_ns, "CameraInfo", frame, width=size[0], height=size[1], distortion_model="plumb_bob",
            K=K, R=R, P=P,
        )  # fmt: skip

    def cloud(
        self, topic: str, time_ns: int, points: np.ndarray, frame: str = "lidar", log_ns: int | None = None
    ) -> None:
        """Writes a structured array of points; its byte order is that of its first field."""
        dtype, n = points.dtype, len(points)
        assert dtype.names is not None and dtype.fields is not None
        numbers = {name: TYPE_NUMBERS[dtype[name].str[1:]] for name in dtype.names}
        fields = [
            {"name": name, "offset": dtype.fields[name][1], "datatype": numbers[name], "count": 1}
            for name in dtype.names
        ]
        self.put(
            topic, time_ns, "PointCloud2", frame, log_ns, height=1, width=n, fields=fields,
            is_bigendian=dtype[0].str[0] == ">", point_step=dtype.itemsize, row_step=n * dtype.itemsize,
            data=np.frombuffer(points.tobytes(), np.uint8),
        )  # fmt: skip

    def transform(self, topic: str, time_ns: int, parent: str, child: str, T: RigidTransform) -> None:
        place, turn = (dict(zip("xyzw", each.tolist(), strict=False)) for each in (T.translation, T.rotation.as_quat()))
        pose = {"translation": place, "rotation": turn}
        stamped = {"header": self.header(time_ns, parent), "child_frame_id": child, "transform": pose}
        self.write(topic, time_ns, "tf2_msgs/TFMessage", transforms=[stamped])

    def imu(self, topic: str, time_ns: int, acceleration: tuple[float, float, float], frame: str = "imu") -> None:
        self.put(topic, time_ns, "Imu", frame, linear_acceleration=dict(zip("xyz", acceleration, strict=True)))


def structured(columns: dict[str, np.ndarray], order: Literal["<", ">"] = "<", padding: int = 0) -> np.ndarray:
    """Returns points with these columns, `padding` bytes between and after them, in a byte order."""
    offsets, at = [], 0
    formats = [values.dtype.newbyteorder(order) for values in columns.values()]
    for kind in formats:
        at += padding
        offsets.append(at)
        at += kind.itemsize
    dtype = np.dtype({"names": list(columns), "formats": formats, "offsets": offsets, "itemsize": at + padding})
    points = np.zeros(len(next(iter(columns.values()))), dtype)
    for name, values in columns.items():
        points[name] = values
    return points


START_NS = 1_700_000_000 * 10**9
MS = 1_000_000
SIZE = (32, 24)
K = np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
IMAGE = np.random.default_rng(5).integers(0, 256, (24, 32, 3), np.uint8)
# x forward, y left, z up
POINTS_M = np.random.default_rng(6).uniform((2, -1, -0.7), (9, 1, 0.7), (200, 3)).astype(np.float32)
T_CAMERA_LIDAR = RigidTransform.from_components(
    [0.1, -0.2, 0.05], Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
)
LIDAR_COLUMNS = dict(zip("xyz", POINTS_M.T, strict=True)) | {"intensity": np.linspace(0, 1, 200, dtype=np.float32)}


def write_camera(bag: BagWriter, name: str, time_ns: int, frame: str = "camera", log_ns: int | None = None) -> None:
    bag.info(f"/{name}/camera_info", time_ns, SIZE, K, frame=frame)
    bag.image(f"/{name}/image_raw", time_ns, IMAGE, "rgb8", frame, log_ns=log_ns)


def write_scan(bag: BagWriter, time_ns: int, log_ns: int | None = None, topic: str = "/points") -> None:
    bag.cloud(topic, time_ns, structured(LIDAR_COLUMNS), log_ns=log_ns)


def write_mount(bag: BagWriter, topic: str = "/tf_static") -> None:
    bag.transform(topic, START_NS, "camera", "lidar", T_CAMERA_LIDAR)


def write_take(bag: BagWriter, frames: int = 3) -> None:
    """A camera and a LiDAR at 10 Hz, 4 ms apart, rigidly mounted."""
    write_mount(bag)
    for i in range(frames):
        write_scan(bag, START_NS + i * 100 * MS)
        write_camera(bag, "cam", START_NS + (i * 100 + 4) * MS)


def seen_points() -> np.ndarray:
    """The points of a scan that the camera sees, in its frame."""
    xyz = T_CAMERA_LIDAR.apply(POINTS_M.astype(np.float64))
    px = xyz @ K.T
    px = px[:, :2] / px[:, 2:]
    return xyz[(xyz[:, 2] > 0.1) & (np.abs(px - (15.5, 11.5)) <= (16, 12)).all(axis=1)].astype(np.float32)
