"""Samples of clouds, camera files, images and KITTI's calibrations; writers of cloud files and messages."""

from __future__ import annotations

import io
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from bag_writer import TYPE_NUMBERS

SCAN = np.c_[np.random.default_rng(1).uniform(-20, 20, (3000, 3)) * [1, 1, 0.2], np.random.default_rng(2).random(3000)]
SCAN = SCAN.astype(np.float32)
PLY_NAMES = {"u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short", "u4": "uint", "i4": "int", "f4": "float",
             "f8": "double"}  # fmt: skip


def camera_file(**more: object) -> str:
    K = [70.0, 0, 0, 0, 72.0, 0, 60.0, 20.0, 1]
    return json.dumps({"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": K, **more})


def image(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def put_image(path: Path, number: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", image(number)[:, :, ::-1])[1].tobytes())


def as_text(rows: np.ndarray) -> bytes:
    flat = (np.concatenate([np.ravel(value) for value in row], dtype=object) for row in rows.tolist())
    return "".join(" ".join(format(value, ".17g") for value in row) + "\n" for row in flat).encode()


def ply(rows: np.ndarray, form: str, before: str = "", after: str = "") -> bytes:
    """Writes structured rows as vertices, with header lines of other elements before and after them."""
    kinds = [(name, PLY_NAMES[rows.dtype[name].str[1:]]) for name in rows.dtype.names or ()]
    head = f"ply\nformat {form} 1.0\ncomment made by \u00c5sa\n{before}element vertex {len(rows)}\n"
    head += "".join(f"property {kind} {name}\n" for name, kind in kinds) + f"{after}end_header\n"
    return head.encode() + (as_text(rows) if form == "ascii" else rows.tobytes())


def lzf(data: bytes) -> bytes:
    """LZF data without any compression, as in PCD: after both sizes."""
    packed = b"".join(bytes([len(part) - 1]) + part for part in (data[i : i + 32] for i in range(0, len(data), 32)))
    return np.array([len(packed), len(data)], "<u4").tobytes() + packed


def pcd(rows: np.ndarray, form: str, body: bytes | None = None, count: int | None = None) -> bytes:
    """Writes structured rows; `body` and `count` replace what they are."""
    names = rows.dtype.names or ()
    kinds, count = [rows.dtype[name] for name in names], len(rows) if count is None else count
    parts = {
        "FIELDS": [name.rstrip("0123456789") if name.startswith("_") else name for name in names],
        "SIZE": [kind.base.itemsize for kind in kinds],
        "TYPE": [kind.base.kind.upper() for kind in kinds],
        "COUNT": [int(np.prod(kind.shape)) for kind in kinds],
    }
    head = "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
    head += "".join(f"{key} {' '.join(map(str, values))}\n" for key, values in parts.items())
    head += f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {form}\n"
    if body is None and form == "binary_compressed":
        body = lzf(b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in names))
    return head.encode() + (body or (as_text(rows) if form == "ascii" else rows.tobytes()))


def npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def npz(**arrays: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def ros_cloud(points: np.ndarray, height: int = 1, row_padding: int = 0, **changed: Any) -> Any:
    """A decoded PointCloud2 message of structured points."""
    dtype, names = points.dtype, points.dtype.names or ()
    places = [(name, dtype.fields[name][1], TYPE_NUMBERS[dtype[name].str[1:]]) for name in names]
    fields = [SimpleNamespace(name=name, offset=at, datatype=kind, count=1) for name, at, kind in places]
    rows = np.frombuffer(points.tobytes(), np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, row_padding)), constant_values=255)
    content = {"width": len(points) // height, "height": height, "fields": fields, "point_step": dtype.itemsize,
               "is_bigendian": any(dtype[name].str[0] == ">" for name in names),
               "row_step": rows.shape[1], "data": rows.reshape(-1)}  # fmt: skip
    return SimpleNamespace(**(content | changed))


WIDTH, HEIGHT = 120, 40
K = np.array([[70.0, 0, 61.0], [0, 72.0, 17.0], [0, 0, 1]])
P2 = np.c_[K, [4.5, 0.2, 0.003]]
R0 = np.array([[0.9999, 0.0098, -0.0074], [-0.0099, 0.9999, -0.0043], [0.0074, 0.0044, 0.9999]])
TR = np.array([[0.0075, -0.9999, -0.0006, -0.004], [0.0148, 0.0007, -0.9999, -0.076], [0.9998, 0.0075, 0.0148, -0.27]])


def row(name: str, matrix: np.ndarray) -> str:
    return f"{name} " + " ".join(f"{value:.12e}" for value in matrix.ravel())


OBJECT_CALIB = "\n".join([row("P2:", P2), row("R0_rect:", R0), row("Tr_velo_to_cam:", TR), ""])
TRACKING_CALIB = "\n".join([row("P2:", P2), row("R_rect", R0), row("Tr_velo_cam", TR), ""])


def by_formula(scan: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels by KITTI's formula P2 * R0_rect * Tr_velo_to_cam * X, and a mask of the points on the image."""
    rectified = R0 @ TR @ np.c_[scan[:, :3].astype(np.float64), np.ones(len(scan))].T
    uvw = P2 @ np.vstack([rectified, np.ones(len(scan))])
    px = (uvw[:2] / uvw[2]).T
    inside = (uvw[2] > 0.1) & (px >= -0.5).all(axis=1) & (px < [WIDTH - 0.5, HEIGHT - 0.5]).all(axis=1)
    return px, inside


CAMERAS = "\n".join(["calib_time: 09-Jan-2012 13:57:47", row("R_rect_00:", R0), row("P_rect_02:", P2), ""])


LIDAR = "\n".join(["calib_time: 15-Mar-2012 11:37:16", row("R:", TR[:, :3]), row("T:", TR[:, 3]), ""])


TIMES = "2011-09-26 13:02:25.964389445\n\n2011-09-26 13:02:26\n2011-09-26 13:02:26.5\n"
