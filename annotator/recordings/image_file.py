"""Reads the colour and depth images of recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16

from annotator.image_bytes import read_image
from annotator.types.errors import FrameError

REMEDY = "copy the file again from its source, or remove the frame"


def read_rgb(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Reads a colour image, RGB order; the EXIF orientation is not applied.

    Raises:
        FrameError: the file is missing, truncated or not an image.
    """
    import cv2

    bgr = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    rgb: np.ndarray = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    return rgb


def read_depth(path: Path) -> UInt16[np.ndarray, "h w"]:
    """Reads a depth image in its raw units.

    Raises:
        FrameError: the file is missing, truncated, not an image, or not 16-bit with one channel.
    """
    return _plane(path, np.uint16, "a depth image", "save the sensor's depth as a 16-bit grey PNG, millimetres")


def read_confidence(path: Path) -> UInt8[np.ndarray, "h w"]:
    """Reads an image of the depth's confidence.

    Raises:
        FrameError: the file is missing, truncated, not an image, or not 8-bit with one channel.
    """
    return _plane(path, np.uint8, "an image of confidence", REMEDY)


def _plane(path: Path, dtype: type[np.generic], what: str, remedy: str) -> np.ndarray:
    import cv2

    raw = _decode(path, cv2.IMREAD_UNCHANGED, give_points=True)
    if raw.ndim != 2 or raw.dtype != dtype:
        channels, bits = 1 if raw.ndim == 2 else raw.shape[2], 8 * np.dtype(dtype).itemsize
        raise FrameError(
            path,
            f"{what} must be {bits}-bit with one channel, not {8 * raw.itemsize}-bit with {channels}",
            remedy,
        )
    return raw


def _decode(path: Path, flags: int, give_points: bool = False) -> np.ndarray:
    try:
        return read_image(path, flags, give_points=give_points)
    except OSError as error:
        raise FrameError(path, f"cannot be read ({error.strerror})", REMEDY) from error
    except ValueError as error:
        raise FrameError(path, str(error), REMEDY) from error
