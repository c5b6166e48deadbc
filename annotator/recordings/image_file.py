"""Reads the colour and depth images of recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16

from annotator.exif import UPRIGHT, Size, described, is_turned, orientation_of, turned
from annotator.frame_limits import read_frame_file
from annotator.image_bytes import decode_image
from annotator.recordings.deep_images import common_levels, eight_bits
from annotator.types.errors import FrameError

REMEDY = "copy the file again from its source, or remove the frame"


@dataclass(frozen=True, eq=False)
class ColorImage:
    """A colour image, RGB order, and its EXIF orientation if that is not applied, else 1."""

    rgb: UInt8[np.ndarray, "h w 3"]
    exif_orientation: int = UPRIGHT


def read_rgb(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Reads the image of a camera whose calibration does not say its size; as `read_color_image`."""
    return read_color_image(path).rgb


def read_color_image(path: Path, size: Size | None = None, *, has_depth: bool = False) -> ColorImage:
    """Reads the image of a calibrated camera, turned as the calibration fits (`annotator.exif`).

    More than 8 bits are reduced to 8, by one depth for the images of a folder (`deep_images`).

    Args:
        size: width and height of the calibration; None if it does not say it.
        has_depth: a depth image of the same camera has no EXIF orientation.

    Raises:
        FrameError: the file is missing, truncated, not an image, or has an EXIF orientation and the calibration may be
            for either.
    """
    import cv2

    data, pixels = _decoded(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    bgr = pixels if pixels.dtype == np.uint8 else eight_bits(pixels, common_levels(path, pixels, _deep_pixels))
    rgb: np.ndarray = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    orientation = orientation_of(data)
    turn = is_turned(orientation, (rgb.shape[1], rgb.shape[0]), size)
    if turn is None and not has_depth:
        raise FrameError(
            path,
            f"it has the {described(orientation)}, and its calibration may be for the image as stored or as shown",
            "save the images as the calibration needs them, without this tag",
        )
    return ColorImage(turned(rgb, orientation)) if turn else ColorImage(rgb, orientation)


def _deep_pixels(path: Path) -> np.ndarray:
    import cv2

    return _decoded(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)[1]


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

    raw = _decoded(path, cv2.IMREAD_UNCHANGED, give_points=True)[1]
    if raw.ndim != 2 or raw.dtype != dtype:
        channels, bits = 1 if raw.ndim == 2 else raw.shape[2], 8 * np.dtype(dtype).itemsize
        raise FrameError(
            path,
            f"{what} must be {bits}-bit with one channel, not {8 * raw.itemsize}-bit with {channels}",
            remedy,
        )
    return raw


def _decoded(path: Path, flags: int, give_points: bool = False) -> tuple[bytes, np.ndarray]:
    """Returns a file's bytes and its pixels."""
    try:
        data = read_frame_file(path)
        return data, decode_image(data, flags, give_points=give_points)
    except OSError as error:
        raise FrameError(path, f"cannot be read ({error.strerror})", REMEDY) from error
    except ValueError as error:
        raise FrameError(path, str(error), REMEDY) from error
