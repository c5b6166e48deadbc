"""PNG and JPEG files: strict decoding, and the EXIF orientation.

OpenCV decodes a truncated file without an error and fills the missing part with grey. So the bytes are checked for
completeness first: truncated, damaged and too large images are errors. PNG: W3C "PNG Specification", section 5 (chunks,
CRC). JPEG: ITU-T T.81, annex B (markers, frame header).

EXIF orientation: how an image file asks to be turned or mirrored when it is shown. Viewers, browsers and most labelling
tools turn the image; a camera's calibration and a depth image usually belong to the pixels as they are stored. One rule
for images, their 2D boxes and their masks:

- A size that fits only one of the two, turned or as stored, decides. It comes from the calibration or the label file.
- A depth image of the same camera decides for the pixels as stored, since it has no such tag.
- Otherwise nothing is guessed: it is refused.

Source: CIPA DC-008 (Exif 2.32), 4.6.4, tag Orientation; PNG third edition, 11.3.3.7, eXIf.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from annotator.frame_limits import read_frame_file, require_pixels
from annotator.types import Box2D

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_START = b"\xff\xd8"
JPEG_END = 0xD9
JPEG_SCAN = 0xDA
# A marker inside entropy-coded data: 0xFF followed by neither a stuffed 0x00, a fill 0xFF nor a restart marker.
JPEG_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]", re.DOTALL)
# The markers of frame headers: 0xC0 to 0xCF except those for tables and extensions.
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Markers without a length, and bytes that are not markers; they are invalid before a frame header.
JPEG_WITHOUT_LENGTH = frozenset({0x00, 0x01, *range(0xD0, 0xDA)})


JPEG_QUALITY = 95


def encoded_image(
    image: np.ndarray, image_format: Literal["png", "jpg"] = "png", jpeg_quality: int = JPEG_QUALITY
) -> bytes:
    """Returns an RGB image, (h, w, 3) uint8, or one of numbers, (h, w) uint8 or uint16, as the bytes of a file.

    Raises:
        OSError: the image is too large for the format.
    """
    import cv2

    settings = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if image_format == "jpg" else []
    pixels = image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    done, data = cv2.imencode(f".{image_format}", pixels, settings)
    if not done:
        height_px, width_px = image.shape[:2]
        raise OSError(0, f"an image of {width_px} x {height_px} pixels is too large for {image_format}")
    return bytes(data.tobytes())


def read_image(path: Path, flags: int) -> np.ndarray:
    """Decodes a PNG or JPEG file as `decode_image`.

    Raises:
        OSError: it cannot be read.
        ValueError: as `decode_image`.
    """
    return decode_image(read_frame_file(path), flags)


def decode_image(data: bytes, flags: int, *, give_points: bool = False) -> np.ndarray:
    """Decodes the bytes of a PNG or JPEG file to an image in OpenCV's layout (BGR).

    Other formats that OpenCV can decode are refused, because their memory use is not bounded.

    Args:
        data: PNG or JPEG.
        flags: OpenCV's, such as `cv2.IMREAD_COLOR`.
        give_points: as `require_pixels`.

    Raises:
        ValueError: truncated, damaged, of another format, or too large (`frame_limits`); the message says which.
    """
    import cv2

    problem = image_problem(data)
    if problem:
        raise ValueError(problem)
    width, height = declared_size(data)
    if width * height == 0:
        raise ValueError("cannot be decoded as a PNG or JPEG image; convert images of other formats to one of these")
    require_pixels(width, height, give_points=give_points)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        # OpenCV has size limits of its own
        image = None
    if image is None:
        raise ValueError("cannot be decoded as an image")
    return np.asarray(image)


def image_problem(data: bytes) -> str:
    """Why a PNG or JPEG file is unusable; "" for a complete file and for other formats."""
    if not data:
        return "the file is empty"
    if data.startswith(PNG_SIGNATURE):
        return _png_problem(data)
    if data.startswith(JPEG_START):
        return _jpeg_problem(data)
    return ""


def _chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yields kind, start and end of the content of each part of a PNG file; the last one may be cut."""
    at = len(PNG_SIGNATURE)
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4])
        yield data[at + 4 : at + 8], at + 8, end
        at = end + 4


def _segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yields marker, start and end of the content of the segments of a JPEG file, up to the first damage."""
    at = len(JPEG_START)
    while at + 4 <= len(data) and data[at] == 0xFF:
        if data[at + 1] == 0xFF:  # fill byte
            at += 1
            continue
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4])
        yield data[at + 1], at + 4, end
        at = end


def _png_problem(data: bytes) -> str:
    for kind, start, end in _chunks(data):
        if end + 4 > len(data):
            break
        if zlib.crc32(data[start - 4 : end]) != int.from_bytes(data[end : end + 4]):
            return f"the PNG image is damaged (checksum of its {kind.decode('latin-1')} part)"
        if kind == b"IEND":
            return ""
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


def declared_size(data: bytes) -> tuple[int, int]:
    """Width and height from the header of a PNG or JPEG file; (0, 0) for other formats or without a header."""
    if data.startswith(PNG_SIGNATURE) and data[12:16] == b"IHDR":
        return int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
    for marker, start, _ in _segments(data) if data.startswith(JPEG_START) else ():
        if marker in JPEG_FRAMES:
            return int.from_bytes(data[start + 3 : start + 5]), int.from_bytes(data[start + 1 : start + 3])
        if marker in JPEG_WITHOUT_LENGTH:
            # a decoder would continue after this byte and might find another header
            break
    return 0, 0


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
APP1, EXIF_MARK, ORIENTATION_TAG, SHORT = 0xE1, b"Exif\0\0", 0x0112, 3
ENTRY_BYTES = 12


def orientation_of(data: bytes) -> int:
    """Returns the EXIF orientation of a PNG or JPEG file, 1 to 8; 1 without a valid one."""
    tiff = _exif(data)
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(tiff[:4])
    if order is None or len(tiff) < 8:
        return UPRIGHT
    at = int(struct.unpack_from(order + "I", tiff, 4)[0])
    count = int(struct.unpack_from(order + "H", tiff, at)[0]) if at + 2 <= len(tiff) else 0
    for entry in range(at + 2, min(at + 2 + count * ENTRY_BYTES, len(tiff) - ENTRY_BYTES + 1), ENTRY_BYTES):
        tag, kind, _, value = struct.unpack_from(order + "HHIH", tiff, entry)
        if tag == ORIENTATION_TAG and kind == SHORT:
            return value if value in HOW else UPRIGHT
    return UPRIGHT


def is_turned(orientation: int, stored: Size, said: Size | None) -> bool | None:
    """True if the size `said` fits only the turned image, False if only the image as stored; None if it does not tell.

    Args:
        stored: the size as stored.
        said: by a calibration or a label file; None = not said.
    """
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
    """Returns a box on the image as viewers show it, in the pixels as stored.

    Args:
        stored: the size as stored.
    """
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
    """Returns the words for an orientation other than 1."""
    return f"EXIF orientation {orientation} ({HOW[orientation]} when it is shown)"


def _exif(data: bytes) -> bytes:
    """Returns the TIFF part of a PNG or JPEG file; empty without one."""
    if data.startswith(PNG_SIGNATURE):
        return next((data[start:end] for kind, start, end in _chunks(data) if kind == b"eXIf"), b"")
    for marker, start, end in _segments(data) if data.startswith(JPEG_START) else ():
        if marker == JPEG_SCAN:
            break
        if marker == APP1 and data.startswith(EXIF_MARK, start):
            return data[start + len(EXIF_MARK) : end]
    return b""
