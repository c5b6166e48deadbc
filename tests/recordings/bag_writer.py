"""Writes bags with the writer of rosbags, in every container, from one description of the messages."""

from __future__ import annotations

import shutil
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import RigidTransform

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

    def type(self, name: str) -> Any:
        package, _, short = name.partition("/")
        return self.store.types[f"{package}/msg/{short}"]

    def stamp(self, time_ns: int) -> Any:
        return self.type("builtin_interfaces/Time")(sec=time_ns // SECOND, nanosec=time_ns % SECOND)

    def header(self, time_ns: int, frame: str) -> Any:
        number = {"seq": 0} if self.is_ros1 else {}
        return self.type("std_msgs/Header")(**number, stamp=self.stamp(time_ns), frame_id=frame)

    def write(self, topic: str, log_ns: int, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self._topics:
            self._topics[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
        self.writer.write(self._topics[topic], log_ns, serialize(message, kind))

    def image(
        self, topic: str, time_ns: int, pixels: np.ndarray, encoding: str, frame: str = "camera", *,
        log_ns: int | None = None, **changed: Any,
    ) -> None:  # fmt: skip
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        fields = {
            "header": self.header(time_ns, frame), "height": len(pixels), "width": pixels.shape[1],
            "encoding": encoding, "is_bigendian": 0, "step": rows.shape[1], "data": rows.reshape(-1),
        } | changed  # fmt: skip
        self.write(topic, time_ns if log_ns is None else log_ns, self.type("sensor_msgs/Image")(**fields))

    def compressed(self, topic: str, time_ns: int, form: str, data: bytes, frame: str = "camera") -> None:
        content = self.type("sensor_msgs/CompressedImage")(
            header=self.header(time_ns, frame), format=form, data=np.frombuffer(data, np.uint8)
        )
        self.write(topic, time_ns, content)

    def info(
        self, topic: str, time_ns: int, size: tuple[int, int], K: np.ndarray, frame: str = "camera", *,
        R: np.ndarray | None = None, P: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        given = {"D": [], "K": K, "R": np.eye(3) if R is None else R, "P": np.zeros(12) if P is None else P}
        matrices = {
            name if self.is_ros1 else name.lower(): np.array(each, float).ravel() for name, each in given.items()
        }
        region = self.type("sensor_msgs/RegionOfInterest")(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
        content = self.type("sensor_msgs/CameraInfo")(
            header=self.header(time_ns, frame), height=size[1], width=size[0], distortion_model="plumb_bob",
            binning_x=0, binning_y=0, roi=region, **matrices,
        )  # fmt: skip
        self.write(topic, time_ns, content)

    def cloud(
        self, topic: str, time_ns: int, points: np.ndarray, frame: str = "lidar", log_ns: int | None = None
    ) -> None:
        """Writes a structured array of points; its byte order is that of its first field."""
        dtype, n = points.dtype, len(points)
        assert dtype.names is not None and dtype.fields is not None
        fields = [
            self.type("sensor_msgs/PointField")(
                name=name, offset=dtype.fields[name][1], datatype=TYPE_NUMBERS[dtype[name].str[1:]], count=1
            )
            for name in dtype.names
        ]
        content = self.type("sensor_msgs/PointCloud2")(
            header=self.header(time_ns, frame), height=1, width=n, fields=fields, is_bigendian=dtype[0].str[0] == ">",
            point_step=dtype.itemsize, row_step=n * dtype.itemsize, data=np.frombuffer(points.tobytes(), np.uint8),
            is_dense=False,
        )  # fmt: skip
        self.write(topic, time_ns if log_ns is None else log_ns, content)

    def transform(self, topic: str, time_ns: int, parent: str, child: str, T: RigidTransform) -> None:
        x, y, z = T.translation.tolist()
        turn = dict(zip("xyzw", T.rotation.as_quat().tolist(), strict=True))
        transform = self.type("geometry_msgs/Transform")(
            translation=self.type("geometry_msgs/Vector3")(x=x, y=y, z=z),
            rotation=self.type("geometry_msgs/Quaternion")(**turn),
        )
        stamped = self.type("geometry_msgs/TransformStamped")(
            header=self.header(time_ns, parent), child_frame_id=child, transform=transform
        )
        kind = self.type("tf2_msgs/TFMessage")
        self.write(topic, time_ns, kind(transforms=[stamped]))

    def imu(self, topic: str, time_ns: int, acceleration: tuple[float, float, float], frame: str = "imu") -> None:
        vector = self.type("geometry_msgs/Vector3")
        x, y, z = acceleration
        content = self.type("sensor_msgs/Imu")(
            header=self.header(time_ns, frame),
            orientation=self.type("geometry_msgs/Quaternion")(x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=np.zeros(9), angular_velocity=vector(x=0.0, y=0.0, z=0.0),
            angular_velocity_covariance=np.zeros(9), linear_acceleration=vector(x=x, y=y, z=z),
            linear_acceleration_covariance=np.zeros(9),
        )  # fmt: skip
        self.write(topic, time_ns, content)


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
