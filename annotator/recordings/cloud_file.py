"""One file of points, whatever its format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from annotator.recordings.cloud_columns import CLOUD_REMEDY, RawCloud, from_columns
from annotator.recordings.kitti_frame import read_scan
from annotator.recordings.las_file import parse_las
from annotator.recordings.numpy_file import parse_npy, parse_npz
from annotator.recordings.pcd_file import parse_pcd
from annotator.recordings.ply_file import parse_ply
from annotator.types.errors import FrameError

PARSERS: dict[str, Callable[[Path, bytes], RawCloud]] = {
    ".ply": parse_ply,
    ".pcd": parse_pcd,
    ".npy": parse_npy,
    ".npz": parse_npz,
    ".las": parse_las,
    ".laz": parse_las,
}
# KITTI's scans have no header, so that their reader looks at the file itself.
SCAN_SUFFIX = ".bin"
CLOUD_SUFFIXES = (*PARSERS, SCAN_SUFFIX)


def read_cloud(path: Path) -> RawCloud:
    """The valid points of a file with one of `CLOUD_SUFFIXES`, in its own frame, metres.

    Raises:
        MissingExtraError: a LAS or LAZ file, and what reads it is not installed.
        FrameError: it is missing, damaged, promises more than it holds, or has no valid point.
    """
    suffix = path.suffix.lower()
    if suffix == SCAN_SUFFIX:
        scan = read_scan(path)
        return from_columns(path, dict(zip(("x", "y", "z", "reflectance"), scan.T.astype(np.float64), strict=True)))
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FrameError(path, f"cannot be read ({error.strerror})", CLOUD_REMEDY) from error
    if not data:
        raise FrameError(path, "the file is empty", CLOUD_REMEDY)
    return PARSERS[suffix](path, data)
