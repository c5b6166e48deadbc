"""Exported point clouds as PLY files: binary, little-endian, one element `vertex`.

Format: Greg Turk, "The PLY Polygon File Format" (1994). Properties: float x y z, then uchar red green blue and
float reflectance if the cloud has them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from annotator.frame_limits import read_frame_file
from annotator.types import PointCloud
from annotator.types.errors import FormatError

XYZ = ("x", "y", "z")
RGB = ("red", "green", "blue")
HEADER_LIMIT = 4096
CAMERA_FRAME = "camera frame: x right, y down, z forward, metres"


def write_ply(path: Path, cloud: PointCloud, comment: str = CAMERA_FRAME) -> None:
    """Writes the points, with colours and reflectances if the cloud has them.

    Args:
        comment: the points' frame of reference, one line of ASCII.

    Raises:
        OSError: the file cannot be written.
    """
    fields = _fields(cloud.rgb is not None, cloud.reflectance is not None)
    rows = np.empty(len(cloud), np.dtype(fields))
    for column, name in enumerate(XYZ):
        rows[name] = cloud.xyz_m[:, column]
    if cloud.rgb is not None:
        for column, name in enumerate(RGB):
            rows[name] = cloud.rgb[:, column]
    if cloud.reflectance is not None:
        rows["reflectance"] = cloud.reflectance
    with path.open("wb") as file:
        file.write(_header(fields, len(cloud), comment))
        file.write(rows.tobytes())


def read_ply(path: Path) -> PointCloud:
    """Reads a file that `write_ply` wrote with the default comment, so in the camera frame."""
    try:
        data = read_frame_file(path)
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    end = data.find(b"end_header\n", 0, HEADER_LIMIT)
    if not data.startswith(b"ply\n") or end < 0:
        raise FormatError(path, "is not a PLY file")
    end += len(b"end_header\n")
    fields, count = _parse_header(path, data[:end])
    dtype = np.dtype(fields)
    if len(data) != end + count * dtype.itemsize:
        raise FormatError(
            path,
            f"declares {count} points ({count * dtype.itemsize} bytes) but has {len(data) - end} bytes",
        )
    rows = np.frombuffer(data, dtype, count, offset=end)
    names = dtype.names or ()
    xyz_m = np.stack([rows[name] for name in XYZ], axis=1).astype(np.float32)
    if not np.isfinite(xyz_m).all():
        raise FormatError(path, "has a point that is NaN or infinite; export the dataset again")
    return PointCloud(
        xyz_m,
        np.stack([rows[name] for name in RGB], axis=1) if "red" in names else None,
        rows["reflectance"].astype(np.float32) if "reflectance" in names else None,
    )


def _fields(colour: bool, reflectance: bool) -> list[tuple[str, str]]:
    """Returns the fields of a row as numpy names them."""
    return (
        [(name, "<f4") for name in XYZ]
        + [(name, "u1") for name in RGB if colour]
        + ([("reflectance", "<f4")] if reflectance else [])
    )


def _header(fields: list[tuple[str, str]], count: int, comment: str = CAMERA_FRAME) -> bytes:
    words = {"<f4": "float", "u1": "uchar"}
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {comment}",
        f"element vertex {count}",
        *(f"property {words[kind]} {name}" for name, kind in fields),
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def _parse_header(path: Path, header: bytes) -> tuple[list[tuple[str, str]], int]:
    """Returns the fields and the number of points of a header that `write_ply` wrote."""
    lines = header.decode("ascii", "replace").splitlines()
    counts = [line.split(" ", 2)[2] for line in lines if line.startswith("element vertex ")]
    names = [line.split()[-1] for line in lines if line.startswith("property ")]
    fields = _fields("red" in names, "reflectance" in names)
    if len(counts) != 1 or not counts[0].isdigit() or header != _header(fields, int(counts[0])):
        raise FormatError(path, "does not have the layout of an rcv dataset's PLY files; see the dataset's README.md")
    return fields, int(counts[0])
