"""Decodes the Azure Kinect's colour images: MJPEG, NV12, YUY2 and BGRA.

YUV is BT.601 with values from 16 to 235, as in the SDK.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from annotator.image_bytes import JPEG_START, declared_size, image_problem

# FourCC of a track -> half bytes per pixel; None for compressed formats.
FORMATS: dict[str, int | None] = {"MJPG": None, "NV12": 3, "YUY2": 4, "BGRA": 8}


def decode_color(fourcc: str, data: bytes, width_px: int, height_px: int) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the RGB image in the bytes of one block.

    Raises:
        ValueError: the bytes are not an image of this format and size; the message says why.
    """
    if fourcc == "MJPG":
        return _decode_jpeg(data, width_px, height_px)
    return _convert(fourcc, data, width_px, height_px)


def _decode_jpeg(data: bytes, width_px: int, height_px: int) -> UInt8[np.ndarray, "h w 3"]:
    import cv2

    problem = image_problem(data)
    if problem:
        raise ValueError(problem)
    # checked before decoding: damaged bytes could declare an image of gigabytes
    if not data.startswith(JPEG_START) or declared_size(data) != (width_px, height_px):
        raise ValueError(f"it is not a JPEG image of {width_px} x {height_px} pixels")
    bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if bgr is None:
        raise ValueError("the JPEG image cannot be decoded")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))


def _convert(fourcc: str, data: bytes, width_px: int, height_px: int) -> UInt8[np.ndarray, "h w 3"]:
    import cv2

    halves = FORMATS[fourcc]
    assert halves is not None
    expected = width_px * height_px * halves // 2
    if len(data) != expected:
        raise ValueError(f"it has {len(data)} bytes, but {width_px} x {height_px} pixels of {fourcc} have {expected}")
    raw = np.frombuffer(data, np.uint8)
    if fourcc == "NV12":
        rgb = cv2.cvtColor(raw.reshape(height_px * 3 // 2, width_px), cv2.COLOR_YUV2RGB_NV12)
    elif fourcc == "YUY2":
        rgb = cv2.cvtColor(raw.reshape(height_px, width_px, 2), cv2.COLOR_YUV2RGB_YUY2)
    else:
        rgb = cv2.cvtColor(raw.reshape(height_px, width_px, 4), cv2.COLOR_BGRA2RGB)
    return np.asarray(rgb)
