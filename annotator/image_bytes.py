"""Strict decoding of PNG and JPEG bytes: truncated, damaged and too large images are errors.

OpenCV decodes a truncated file without an error and fills the missing part with grey. So the bytes are checked for
completeness first. PNG: W3C "PNG Specification", section 5 (chunks, CRC). JPEG: ITU-T T.81, annex B (markers, frame
header).
"""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import numpy as np

from annotator.frame_limits import read_frame_file, require_pixels

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


def read_image(path: Path, flags: int, *, give_points: bool = False) -> np.ndarray:
    """Decodes a PNG or JPEG file as `decode_image`.

    Raises:
        OSError: it cannot be read.
        ValueError: as `decode_image`.
    """
    return decode_image(read_frame_file(path), flags, give_points=give_points)


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


def declared_size(data: bytes) -> tuple[int, int]:
    """Width and height from the header of a PNG or JPEG file; (0, 0) for other formats or without a header."""
    if data.startswith(PNG_SIGNATURE) and data[12:16] == b"IHDR":
        return int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
    at = len(JPEG_START) if data.startswith(JPEG_START) else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        if data[at + 1] in JPEG_FRAMES:
            return int.from_bytes(data[at + 7 : at + 9]), int.from_bytes(data[at + 5 : at + 7])
        if data[at + 1] in JPEG_WITHOUT_LENGTH:
            # a decoder would continue after this byte and might find another header
            break
        at += 1 if data[at + 1] == 0xFF else 2 + int.from_bytes(data[at + 2 : at + 4])
    return 0, 0
