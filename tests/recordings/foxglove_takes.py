"""Messages of Foxglove's schemas, and MCAP files with them."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bag_writer import IMAGE, POINTS_M, SIZE, START_NS, T_CAMERA_LIDAR, K
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.writer import CompressionType, IndexType, Writer

DOUBLE, FIXED32, BYTES, STRING, MESSAGE, INT64, INT32 = 1, 7, 12, 9, 11, 3, 5
REPEATED = 3
# names and numbers of fields as in Foxglove's schemas
SCHEMAS: dict[str, list[tuple[int, str, int, str]]] = {
    "google.protobuf.Timestamp": [(1, "seconds", INT64, ""), (2, "nanos", INT32, "")],
    "foxglove.Vector3": [(1, "x", DOUBLE, ""), (2, "y", DOUBLE, ""), (3, "z", DOUBLE, "")],
    "foxglove.Quaternion": [(number, name, DOUBLE, "") for number, name in enumerate("xyzw", 1)],
    "foxglove.Pose": [(1, "position", MESSAGE, "foxglove.Vector3"), (2, "orientation", MESSAGE, "foxglove.Quaternion")],
    "foxglove.PackedElementField": [(1, "name", STRING, ""), (2, "offset", FIXED32, ""), (3, "type", INT32, "")],
    "foxglove.CompressedImage": [(1, "timestamp", MESSAGE, "google.protobuf.Timestamp"), (4, "frame_id", STRING, ""),
                                 (2, "data", BYTES, ""), (3, "format", STRING, "")],
    "foxglove.CompressedVideo": [(1, "timestamp", MESSAGE, "google.protobuf.Timestamp"), (2, "frame_id", STRING, ""),
                                 (3, "data", BYTES, ""), (4, "format", STRING, "")],
    "foxglove.CameraCalibration": [(1, "timestamp", MESSAGE, "google.protobuf.Timestamp"), (9, "frame_id", STRING, ""),
                                   (2, "width", FIXED32, ""), (3, "height", FIXED32, ""),
                                   (4, "distortion_model", STRING, ""), (5, "D", DOUBLE, "*"), (6, "K", DOUBLE, "*"),
                                   (7, "R", DOUBLE, "*"), (8, "P", DOUBLE, "*")],
    "foxglove.PointCloud": [(1, "timestamp", MESSAGE, "google.protobuf.Timestamp"), (2, "frame_id", STRING, ""),
                            (3, "pose", MESSAGE, "foxglove.Pose"), (4, "point_stride", FIXED32, ""),
                            (5, "fields", MESSAGE, "*foxglove.PackedElementField"), (6, "data", BYTES, "")],
    "foxglove.FrameTransform": [(1, "timestamp", MESSAGE, "google.protobuf.Timestamp"),
                                (2, "parent_frame_id", STRING, ""), (3, "child_frame_id", STRING, ""),
                                (4, "translation", MESSAGE, "foxglove.Vector3"),
                                (5, "rotation", MESSAGE, "foxglove.Quaternion")],
}  # fmt: skip


def file_set() -> descriptor_pb2.FileDescriptorSet:
    files = descriptor_pb2.FileDescriptorSet()
    for full, fields in SCHEMAS.items():
        package, _, name = full.rpartition(".")
        used = {kind.lstrip("*") for _, _, _, kind in fields if kind.lstrip("*")}
        needed = [f"{name}.proto" for name in used]
        file = files.file.add(name=f"{full}.proto", package=package, syntax="proto3", dependency=needed)
        message = file.message_type.add(name=name)
        for number, field, kind, target in fields:
            is_many = target.startswith("*")
            described = message.field.add(name=field, number=number, type=kind, label=REPEATED if is_many else 1)
            if target.lstrip("*"):
                described.type_name = "." + target.lstrip("*")
    return files


def foxglove_take(
    encoding: str, picture: dict[str, Any], kind: str = "foxglove.CompressedImage", time_ns: int = START_NS
) -> dict[str, Any]:
    """The messages of one moment as plain values: topic -> (type, values)."""
    names = ("seconds", "nanos") if encoding == "protobuf" else ("sec", "nsec")
    stamp = dict(zip(names, divmod(time_ns, 10**9), strict=True))
    place, turn = T_CAMERA_LIDAR.translation, T_CAMERA_LIDAR.rotation.as_quat()
    xyz = np.ascontiguousarray(POINTS_M)
    fields = [{"name": name, "offset": 4 * i, "type": 7} for i, name in enumerate("xyz")]
    here = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    return {
        "/image": (kind, {"timestamp": stamp, "frame_id": "camera", **picture}),
        "/calibration": ("foxglove.CameraCalibration", {
            "timestamp": stamp, "frame_id": "camera", "width": SIZE[0], "height": SIZE[1], "distortion_model": "",
            "D": [], "K": K.ravel().tolist(), "R": np.eye(3).ravel().tolist(), "P": [0.0] * 12}),
        "/lidar": ("foxglove.PointCloud", {
            "timestamp": stamp, "frame_id": "lidar", "pose": here, "point_stride": 12, "fields": fields,
            "data": xyz.tobytes()}),
        "/tf_static": ("foxglove.FrameTransform", {
            "timestamp": stamp, "parent_frame_id": "camera", "child_frame_id": "lidar",
            "translation": dict(zip("xyz", place.tolist(), strict=True)),
            "rotation": dict(zip("xyzw", turn.tolist(), strict=True))}),
    }  # fmt: skip


def picture_take(encoding: str, rgb: np.ndarray = IMAGE, time_ns: int = START_NS) -> dict[str, Any]:
    """`foxglove_take` with a PNG file."""
    png = cv2.imencode(".png", rgb[:, :, ::-1])[1].tobytes()
    return foxglove_take(encoding, {"data": png, "format": "png"}, time_ns=time_ns)


def encode(encoding: str, kind: str, values: dict[str, Any]) -> bytes:
    if encoding == "json":
        return json.dumps(values, default=lambda data: base64.b64encode(data).decode()).encode()
    pool = descriptor_pool.DescriptorPool()
    for file in file_set().file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(kind))(**values).SerializeToString()


def write_mcap(path: Path, encoding: str, moments: list[tuple[int, dict[str, Any]]], **how: Any) -> None:
    with path.open("wb") as file:
        writer = Writer(file, **how)
        writer.start("", "test")
        channels: dict[str, int] = {}
        schema = file_set().SerializeToString()
        for time_ns, take in moments:
            for topic, (kind, values) in take.items():
                if topic not in channels:
                    name, data = ("protobuf", schema) if encoding == "protobuf" else ("jsonschema", b"{}")
                    channels[topic] = writer.register_channel(topic, encoding, writer.register_schema(kind, name, data))
                writer.add_message(channels[topic], time_ns, encode(encoding, kind, values), time_ns)
        writer.finish()


WRITERS: list[dict[str, Any]] = [
    {"use_chunking": False}, {"compression": CompressionType.LZ4}, {"index_types": IndexType.NONE},
    {"repeat_channels": False, "repeat_schemas": False, "chunk_size": 100},
]  # fmt: skip
