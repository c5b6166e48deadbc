"""Point clouds from `sensor_msgs/PointCloud2` and `foxglove.PointCloud`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.recordings.clouds.columns import RawCloud, from_columns
from annotator.recordings.ros.decode import byte_array

# sensor_msgs/PointField.msg and foxglove.PackedElementField.NumericType
ROS_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
FOXGLOVE_TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}
MOST_FIELDS = 256
LARGEST_POINT = 1 << 16


def read_cloud(path: Path, content: Any) -> RawCloud:
    """Returns the cloud of a decoded message, in the frame that it names.

    Raises:
        ValueError: the message contradicts itself.
        FrameError: it has no coordinates, or no valid point.
    """
    if hasattr(content, "point_stride"):
        return _foxglove_cloud(path, content)
    width, height, row = int(content.width), int(content.height), int(content.row_step)
    size, data = int(content.point_step), byte_array(content.data)
    row = row or width * size
    end = row * (height - 1) + width * size if width * height else 0
    if row < width * size or end > len(data):
        raise ValueError(
            f"declares {width} x {height} points of {size} bytes in rows of {row} bytes, but has {len(data)} bytes"
        )
    order = ">" if content.is_bigendian else "<"
    fields = [(str(field.name), int(field.offset), order + ROS_TYPES.get(int(field.datatype), ""), int(field.count))
              for field in content.fields]  # fmt: skip
    dtype = _point_type(size, fields)
    if row == width * size:
        points = np.frombuffer(data, dtype, width * height)
    else:
        points = np.ndarray((height, width), dtype, data, 0, (row, size)).reshape(-1)
    return from_columns(path, _columns(points))


def _foxglove_cloud(path: Path, content: Any) -> RawCloud:
    size, data = int(content.point_stride), byte_array(content.data)
    fields = [(str(field.name), int(field.offset), "<" + FOXGLOVE_TYPES.get(int(field.type), ""), 1)
              for field in content.fields]  # fmt: skip
    raw = from_columns(path, _columns(np.frombuffer(data, _point_type(size, fields), len(data) // size)))
    pose = getattr(content, "pose", None)
    if pose is None:
        return raw
    turn = [float(getattr(pose.orientation, name)) for name in "xyzw"]
    place = [float(getattr(pose.position, name)) for name in "xyz"]
    if not any(turn):
        turn = [0.0, 0.0, 0.0, 1.0]
    T = RigidTransform.from_components(place, Rotation.from_quat(turn))
    return replace(raw, xyz_m=T.apply(raw.xyz_m))


def _point_type(size: int, fields: list[tuple[str, int, str, int]]) -> np.dtype:
    """Returns the type of a point; fields of an unknown type or of several values are left out."""
    if not 0 < size <= LARGEST_POINT or len(fields) > MOST_FIELDS:
        raise ValueError(f"declares {len(fields)} fields in points of {size} bytes")
    used = {}
    for name, offset, kind, count in fields:
        if len(kind) < 3 or count > 1 or name.lower() in used:
            continue
        if offset < 0 or offset + np.dtype(kind).itemsize > size:
            raise ValueError(f"has a field {name} at byte {offset}, outside of a point of {size} bytes")
        used[name.lower()] = (kind, offset)
    kinds, offsets = [kind for kind, _ in used.values()], [offset for _, offset in used.values()]
    return np.dtype({"names": list(used), "formats": kinds, "offsets": offsets, "itemsize": size})


def _columns(points: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the columns by name, in the machine's byte order."""
    names = points.dtype.names or ()
    return {name: points[name].astype(points.dtype[name].newbyteorder("=")) for name in names}
