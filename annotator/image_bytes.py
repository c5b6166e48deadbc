"""PNG and JPEG files: strict decoding, and the EXIF orientation.

Truncated, damaged and too large images are errors. OpenCV decodes; PIL reads the header before, and checks a PNG's
parts, of which OpenCV's decoder would complain on the terminal.

EXIF orientation: how an image file asks to be turned or mirrored when it is shown. Viewers, browsers and most labelling
tools turn the image; a camera's calibration and a depth image usually belong to the pixels as they are stored. One rule
for images, their 2D boxes and their masks:

- A size that fits only one of the two, turned or as stored, decides. It comes from the calibration or the label file.
- A depth image of the same camera decides for the pixels as stored, since it has no such tag.
- Otherwise nothing is guessed: it is refused.

Source: CIPA DC-008 (Exif 2.32), 4.6.4, tag Orientation; PNG third edition, 11.3.3.7, eXIf.
"""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from annotator.frame_limits import read_frame_file, require_pixels
from annotator.types import Box2D

if TYPE_CHECKING:
    from PIL.ImageFile import ImageFile

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_START = b"\xff\xd8"
JPEG_QUALITY = 95


def encoded_image(
    image: np.ndarray, image_format: Literal["png", "jpg"] = "png", jpeg_quality: int = JPEG_QUALITY
) -> bytes:
    """Returns an RGB image, (h, w, 3) uint8, or one of numbers, (h, w) uint8 or uint16, as the bytes of a file."""
    import cv2

    settings = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if image_format == "jpg" else []
    pixels = image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    done, data = cv2.imencode(f".{image_format}", pixels, settings)
    if not done:
        height_px, width_px = image.shape[:2]
        raise OSError(0, f"an image of {width_px} x {height_px} pixels is too large for {image_format}")
    return bytes(data.tobytes())


def read_image(path: Path, flags: int) -> np.ndarray:
    return decode_image(read_frame_file(path), flags)


def decode_image(data: bytes, flags: int, *, give_points: bool = False) -> np.ndarray:
    """Decodes the bytes of a PNG or JPEG file to an image in OpenCV's layout (BGR), as OpenCV's `flags` say.

    Other formats that OpenCV can decode are refused, because their memory use is not bounded.

    Raises:
        ValueError: truncated, damaged, of another format, or too large (`frame_limits`); the message says which.
    """
    import cv2

    if not data:
        raise ValueError("the file is empty")
    file = _opened(data)
    if file is None:
        is_known = data.startswith((PNG_SIGNATURE, JPEG_START))
        why = "its header is damaged or truncated" if is_known else "convert images of other formats to one of these"
        raise ValueError(f"cannot be decoded as a PNG or JPEG image; {why}")
    require_pixels(*file.size, give_points=give_points)
    try:
        file.verify()
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    # of a damaged file, PIL raises any
    except Exception:
        image = None
    if image is None:
        raise ValueError("the image is damaged or truncated")
    return np.asarray(image)


def _opened(data: bytes) -> ImageFile | None:
    """Returns a PNG or JPEG file whose header is read; None for other formats, and a damaged header."""
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.PngImagePlugin import PngImageFile

    try:
        # not PIL's own `open`, which has another limit of pixels
        return (PngImageFile if data.startswith(PNG_SIGNATURE) else JpegImageFile)(io.BytesIO(data))
    except Exception:
        return None


def declared_size(data: bytes) -> tuple[int, int]:
    """Width and height from the header of a PNG or JPEG file; (0, 0) for other formats or without a header."""
    file = _opened(data)
    return (0, 0) if file is None else file.size


Size = tuple[int, int]
"""Width and height, pixels."""
UPRIGHT = 1
HOW = {
    2: "mirrored",
    3: "turned by 180 degrees",
    4: "mirrored and turned by 180 degrees",
    5: "mirrored and turned by a quarter",
    6: "turned by a quarter",
    7: "mirrored and turned by a quarter",
    8: "turned by a quarter",
}
# The others are their own inverses.
INVERSE = {6: 8, 8: 6}
ORIENTATION_TAG = 0x0112


def orientation_of(data: bytes) -> int:
    """Returns the EXIF orientation of a PNG or JPEG file, 1 to 8; 1 without a valid one."""
    from PIL.Image import Exif

    file, exif = _opened(data), Exif()
    try:
        exif.load(b"" if file is None else file.info.get("exif") or _exif_behind_pixels(data))
        orientation = exif.get(ORIENTATION_TAG)
    except Exception:
        return UPRIGHT
    return int(orientation) if orientation in HOW else UPRIGHT


def _exif_behind_pixels(data: bytes) -> bytes:
    """Returns EXIF that a PNG file has after its pixels, where PIL looks only while it decodes them."""
    at = len(PNG_SIGNATURE)
    while data.startswith(PNG_SIGNATURE) and at + 8 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4])
        if data[at + 4 : at + 8] == b"eXIf":
            return data[at + 8 : end]
        at = end + 4
    return b""


def is_turned(orientation: int, stored: Size, said: Size | None) -> bool | None:
    """True if the size `said` fits only the turned image, False if only that as stored; None if it does not tell."""
    if orientation == UPRIGHT:
        return False
    turned = turned_size(orientation, stored)
    if said is None or turned == stored or said not in (stored, turned):
        return None
    return said == turned


def turned_size(orientation: int, size: Size) -> Size:
    """Returns the size of the turned image; of a turned one, that as stored."""
    return (size[1], size[0]) if orientation >= 5 else size


def turned(image: np.ndarray, orientation: int) -> np.ndarray:
    """Returns an image (h, w, ...) as viewers show it."""
    flipped = image.swapaxes(0, 1) if orientation >= 5 else image
    # then from left to right, and from top to bottom
    if orientation in (2, 3, 6, 7):
        flipped = flipped[:, ::-1]
    if orientation in (3, 4, 7, 8):
        flipped = flipped[::-1]
    return np.ascontiguousarray(flipped)


def as_stored(image: np.ndarray, orientation: int) -> np.ndarray:
    """Returns the pixels as stored of an image (h, w, ...) as viewers show it."""
    return turned(image, INVERSE.get(orientation, orientation))


def box_as_stored(box: Box2D, orientation: int, stored: Size) -> Box2D:
    """Returns a box on the image as viewers show it, in the pixels as stored, of the size `stored`."""
    width, height = turned_size(orientation, stored)
    x, y = (box.x_min, box.x_max), (box.y_min, box.y_max)
    if orientation in (2, 3, 6, 7):
        x = (width - 1 - x[1], width - 1 - x[0])
    if orientation in (3, 4, 7, 8):
        y = (height - 1 - y[1], height - 1 - y[0])
    if orientation >= 5:
        x, y = y, x
    return replace(box, x_min=x[0], x_max=x[1], y_min=y[0], y_max=y[1])


def described(orientation: int) -> str:
    return f"EXIF orientation {orientation} ({HOW[orientation]} when it is shown)"
