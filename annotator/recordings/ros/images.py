"""Pictures from messages: `Image`, `CompressedImage`, and the forms of Foxglove.

Encodings: `sensor_msgs/image_encodings.hpp`; `compressedDepth`: `compressed_depth_image_transport` (a header of twelve
bytes, then PNG or RVL; floats are quantised inverse depths).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from annotator.frame_limits import require_pixels
from annotator.geometry.projection import in_metres
from annotator.image_bytes import decode_image
from annotator.recordings.deep_images import Levels, contrast_levels, depth_levels, eight_bits
from annotator.recordings.ros.decode import FIELD_ERRORS, byte_array
from annotator.recordings.ros.rvl import decode_rvl

# bytes per value and channels of the encodings without colour conversion
PLAIN: dict[str, tuple[str, int]] = {
    "rgb8": ("u1", 3), "bgr8": ("u1", 3), "rgba8": ("u1", 4), "bgra8": ("u1", 4), "mono8": ("u1", 1),
    "8UC1": ("u1", 1), "8UC3": ("u1", 3), "8UC4": ("u1", 4), "mono16": ("u2", 1), "16UC1": ("u2", 1),
    "rgb16": ("u2", 3), "bgr16": ("u2", 3), "32FC1": ("f4", 1),
}  # fmt: skip
# OpenCV names a Bayer pattern by its second row, ROS by its first.
BAYER = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}
YUV422 = {
    "yuv422": "UYVY",
    "uyvy": "UYVY",
    "yuv422_uyvy": "UYVY",
    "yuv422_yuy2": "YUY2",
    "yuyv": "YUY2",
    "yuy2": "YUY2",
}
DEPTH_ENCODINGS = ("16UC1", "32FC1", "mono16")
COMPRESSED_DEPTH = "compressedDepth"
DEPTH_HEAD = struct.Struct("<iff")


@dataclass(frozen=True)
class Picture:
    """What an image message says about itself.

    Attributes:
        encoding: of its pixels; for compressed ones as the format names it ("" if it does not).
        width_px, height_px: 0 if only the compressed bytes know it.
        is_depth: the pixels are depths.
    """

    encoding: str
    width_px: int
    height_px: int
    is_depth: bool


def describe(content: Any, topic: str) -> Picture:
    """Describes an image message; 16-bit grey is depth if its topic says so."""
    if not hasattr(content, "encoding"):
        encoding = str(content.format).partition(";")[0].strip()
        return Picture(encoding, 0, 0, COMPRESSED_DEPTH in str(content.format) or encoding in DEPTH_ENCODINGS[:2])
    encoding, name = str(content.encoding), topic.lower()
    is_depth = encoding == "32FC1" or (encoding == "16UC1" and "infra" not in name and "/ir" not in name)
    is_depth = is_depth or (encoding == "mono16" and "depth" in name)
    return Picture(encoding, int(content.width), int(content.height), is_depth)


def color_image(content: Any, common: Callable[[Levels], Levels] = lambda own: own) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the picture of an image message, RGB order.

    Args:
        common: returns the levels of a topic, given those of a picture of more than 8 bits (`deep_images`).

    Raises:
        ValueError: it is damaged, contradicts itself, or has an unknown encoding.
    """
    import cv2

    if not hasattr(content, "encoding"):
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        bgr = decode_image(byte_array(content.data).tobytes(), flags)
        is_grey = bgr.dtype == np.uint16 and bool((bgr == bgr[:, :, :1]).all())
        return np.ascontiguousarray(_shallow(bgr, common, is_grey)[:, :, ::-1])
    encoding = str(content.encoding)
    if encoding.startswith("bayer_"):
        depth = "u2" if encoding.endswith("16") else "u1"
        pattern = BAYER.get(encoding[6:10])
        if pattern is None:
            raise ValueError(f"has the unknown encoding {encoding!r}")
        values = _shallow(_values(content, depth, 1)[:, :, 0], common, is_grey=False)
        return np.asarray(cv2.cvtColor(values, getattr(cv2, f"COLOR_Bayer{pattern}2RGB")))
    if encoding.lower() in YUV422:
        values = np.ascontiguousarray(_values(content, "u1", 2))
        return np.asarray(cv2.cvtColor(values, getattr(cv2, f"COLOR_YUV2RGB_{YUV422[encoding.lower()]}")))
    if encoding not in PLAIN or encoding == "32FC1":
        known = ", ".join([*PLAIN, *(f"bayer_{pattern}8" for pattern in BAYER), *YUV422])
        raise ValueError(f"has the encoding {encoding!r}, which is not a picture's; known are {known}")
    values = _values(content, *PLAIN[encoding])
    values = _shallow(values, common, encoding in ("mono16", "16UC1"))
    if values.shape[2] == 1:
        values = np.repeat(values, 3, axis=2)
    is_bgr = encoding.startswith(("bgr", "8UC"))
    return np.ascontiguousarray(values[:, :, 2::-1] if is_bgr else values[:, :, :3])


def levels_of(read: Callable[[int], Any], numbers: Sequence[int]) -> list[Levels]:
    """Returns the levels of those of some messages that have more than 8 bits.

    Args:
        read: returns a message; one that is damaged is left to its own frame.
    """
    found: list[Levels] = []

    def note(own: Levels) -> Levels:
        found.append(own)
        return own

    for number in numbers:
        with suppress(*FIELD_ERRORS, OSError):
            color_image(read(number), note)
    return found


def depth_image(content: Any, unit_m: float | None = None) -> Float32[np.ndarray, "h w"]:
    """Returns the depths of an image message, metres; 0 = none.

    Args:
        unit_m: metres of one unit of whole numbers; None = millimetres.

    Raises:
        ValueError: it is damaged, contradicts itself, or is not depth.
    """
    if hasattr(content, "encoding"):
        encoding = str(content.encoding)
        if encoding not in DEPTH_ENCODINGS:
            raise ValueError(f"has the encoding {encoding!r}, which is not depth (16UC1, mono16 or 32FC1)")
        values = _values(content, *PLAIN[encoding])[:, :, 0]
    else:
        values = _compressed_depth(str(content.format), byte_array(content.data).tobytes())
    if values.dtype.kind == "f":
        return in_metres(values, 1.0)
    return in_metres(values, 1000.0) if unit_m is None else in_metres(values, 1.0) * np.float32(unit_m)


def _compressed_depth(form: str, data: bytes) -> np.ndarray:
    import cv2

    start = DEPTH_HEAD.size if COMPRESSED_DEPTH in form else 0
    if start and len(data) < start:
        raise ValueError("its compressed depth is truncated")
    values = decode_rvl(data[start:]) if "rvl" in form.lower() else decode_image(data[start:], cv2.IMREAD_UNCHANGED)
    if values.ndim != 2 or values.dtype != np.uint16:
        raise ValueError("its picture has no 16-bit depths")
    if not form.startswith("32FC1"):
        return values
    _, quantum, offset = DEPTH_HEAD.unpack_from(data)
    with np.errstate(all="ignore"):
        inverse = np.float32(quantum) / (values.astype(np.float32) - np.float32(offset))
    return np.where(values > 0, inverse, np.float32(0))


def _values(content: Any, kind: str, channels: int) -> np.ndarray:
    """Returns the pixels, (h, w, channels), without the padding of the rows."""
    width, height, step = int(content.width), int(content.height), int(content.step)
    size = np.dtype(kind).itemsize * channels
    data = byte_array(content.data)
    require_pixels(width, height)
    step = step or width * size
    if step < width * size or len(data) < step * (height - 1) + width * size:
        raise ValueError(
            f"contradicts itself: {width} x {height} pixels of {content.encoding} in rows of {step} bytes do not fit "
            f"its {len(data)} bytes"
        )
    rows = np.lib.stride_tricks.as_strided(data, (height, width * size), (step, 1), writeable=False)
    order = ">" if getattr(content, "is_bigendian", 0) else "<"
    values = np.ascontiguousarray(rows).view(np.dtype(order + kind))
    return values.reshape(height, width, channels).astype(np.dtype(kind), copy=False)


def _shallow(values: np.ndarray, common: Callable[[Levels], Levels], is_grey: bool) -> np.ndarray:
    """Returns pixels of 8 or 16 bits as 8 bits."""
    if values.dtype == np.uint8:
        return values
    return eight_bits(values, common(contrast_levels(values) if is_grey else depth_levels(values)))
