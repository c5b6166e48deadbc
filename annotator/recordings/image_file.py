"""Image files, read strictly: half a picture is an error, not a grey area.

OpenCV decodes the part of a cut-off file that it gets and fills up the rest, so completeness is checked on the
bytes first. PNG: W3C "PNG Specification", section 5 (chunks, CRC). JPEG: ITU-T T.81, annex B (markers).
"""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16

from annotator.types.errors import FrameError

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_START = b"\xff\xd8"
JPEG_END = 0xD9
JPEG_SCAN = 0xDA
# A marker inside entropy-coded data: 0xFF followed by neither a stuffed 0x00, a fill 0xFF nor a restart marker.
JPEG_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]", re.DOTALL)
REMEDY = "copy the file again from its source, or remove the frame"


def read_rgb(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """A colour image, RGB order, as it lies in the file (a camera's orientation tag is not applied).

    Raises:
        FrameError: the file is missing, truncated or not an image.
    """
    import cv2

    bgr = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.ascontiguousarray(bgr[:, :, ::-1])


def read_depth(path: Path) -> UInt16[np.ndarray, "h w"]:
    """A depth image in its raw units.

    Raises:
        FrameError: the file is missing, truncated, not an image, or not 16-bit with one channel.
    """
    import cv2

    raw = _decode(path, cv2.IMREAD_UNCHANGED)
    if raw.ndim != 2 or raw.dtype != np.uint16:
        channels = 1 if raw.ndim == 2 else raw.shape[2]
        raise FrameError(
            path,
            f"a depth image must be 16-bit with one channel, this one is {8 * raw.itemsize}-bit with {channels}",
            "save the sensor's depth as a 16-bit grey PNG, millimetres",
        )
    return raw


def _decode(path: Path, flags: int) -> np.ndarray:
    import cv2

    try:
        data = path.read_bytes()
    except OSError as error:
        raise FrameError(path, f"cannot be read ({error.strerror})", REMEDY) from error
    problem = image_problem(data)
    if problem:
        raise FrameError(path, problem, REMEDY)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None:
        raise FrameError(path, "cannot be decoded as an image", REMEDY)
    return np.asarray(image)


def image_problem(data: bytes) -> str:
    """What is wrong with the bytes of a PNG or JPEG file, or "" where they are complete (or of another kind)."""
    if not data:
        return "the file is empty"
    if data.startswith(PNG_SIGNATURE):
        return _png_problem(data)
    if data.startswith(JPEG_START):
        return _jpeg_problem(data)
    return ""


def _png_problem(data: bytes) -> str:
    at = len(PNG_SIGNATURE)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4])
        end = at + 12 + length
        if end > len(data):
            break
        kind = data[at + 4 : at + 8]
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end]):
            return f"the PNG image is damaged (checksum of its {kind.decode('latin-1')} part)"
        if kind == b"IEND":
            return ""
        at = end
    return "the PNG image is truncated"


def _jpeg_problem(data: bytes) -> str:
    at = len(JPEG_START)
    while at + 4 <= len(data) and data[at] == 0xFF:
        if data[at + 1] == 0xFF:  # fill byte
            at += 1
            continue
        if data[at + 1] == JPEG_END:
            return ""
        is_scan = data[at + 1] == JPEG_SCAN
        at += 2 + int.from_bytes(data[at + 2 : at + 4])
        if is_scan:
            marker = JPEG_MARKER.search(data, at)
            if marker is None:
                break
            if marker.group()[1] == JPEG_END:
                return ""
            at = marker.start()
    return "the JPEG image is truncated"
