"""Reads a point cloud file of any supported format."""

from __future__ import annotations

import codecs
from collections.abc import Callable
from pathlib import Path

from annotator.frame_limits import read_frame_file
from annotator.recordings.clouds.columns import CLOUD_REMEDY, RawCloud, files_like
from annotator.recordings.clouds.las_file import parse_las
from annotator.recordings.clouds.numpy_file import parse_npy, parse_npz
from annotator.recordings.clouds.pcd_file import parse_pcd
from annotator.recordings.clouds.ply_file import parse_ply
from annotator.recordings.scan_file import SCAN_SUFFIX, Scans
from annotator.types.errors import FrameError

PARSERS: dict[str, Callable[[Path, bytes], RawCloud]] = {
    ".ply": parse_ply,
    ".pcd": parse_pcd,
    ".npy": parse_npy,
    ".npz": parse_npz,
    ".las": parse_las,
    ".laz": parse_las,
}
CLOUD_SUFFIXES = (*PARSERS, SCAN_SUFFIX)


def read_cloud(path: Path, scans: Scans | None = None) -> RawCloud:
    """Returns the valid points of a file with one of `CLOUD_SUFFIXES`, in its own frame, metres.

    Args:
        scans: reads `.bin` files, and has the scale of reflectance; None = this file alone decides.

    Raises:
        UnclearError: a `.bin` file with an uncertain number of values per point.
        MissingExtraError: a LAS or LAZ file, but the extra `las` is not installed.
        FrameError: the file is missing, damaged, shorter than its header says, or has no valid point.
    """
    if path.suffix.lower() == SCAN_SUFFIX:
        return (scans or Scans()).read(path)
    raw = _parsed(path)
    return raw if scans is None else scans.scale.apply(path.parent, raw, lambda: files_like(path), _parsed)


def _parsed(path: Path) -> RawCloud:
    try:
        data = read_frame_file(path)
    except OSError as error:
        raise FrameError(path, f"cannot be read ({error.strerror})", CLOUD_REMEDY) from error
    if not data:
        raise FrameError(path, "the file is empty", CLOUD_REMEDY)
    # headers that an editor has saved
    return PARSERS[path.suffix.lower()](path, data.removeprefix(codecs.BOM_UTF8))
