"""The bytes of a picture, decoded strictly: half a picture is an error, not a grey area, and one too large is refused.

OpenCV decodes the part of a cut-off file that it gets and fills up the rest, so completeness is checked on the
bytes first. PNG: W3C "PNG Specification", section 5 (chunks, CRC). JPEG: ITU-T T.81, annex B (markers, frame header).
"""

from __future__ import annotations

import re
import zlib

import numpy as np

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_START = b"\xff\xd8"
JPEG_END = 0xD9
JPEG_SCAN = 0xDA
# A marker inside entropy-coded data: 0xFF followed by neither a stuffed 0x00, a fill 0xFF nor a restart marker.
JPEG_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]", re.DOTALL)
# The markers of frame headers: all of 0xC0 to 0xCF but those for tables and extensions.
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Markers without a length, and what stands for no marker; none belongs before a frame header.
JPEG_WITHOUT_LENGTH = frozenset({0x00, 0x01, *range(0xD0, 0xDA)})
# A few kilobytes can promise a picture that fills the memory: 67 million pixels, 200 MB in colour.
MOST_PIXELS = 1 << 26


def decode_picture(data: bytes, flags: int) -> np.ndarray:
    """The picture that the bytes of an image file hold, as OpenCV gives it (BGR).

    OpenCV knows other formats, too, but nothing bounds what it takes to decode them.

    Args:
        data: PNG or JPEG.
        flags: OpenCV's, such as `cv2.IMREAD_COLOR`.

    Raises:
        ValueError: they are cut off, damaged, of another format, or a picture of more than `MOST_PIXELS`; says which.
    """
    import cv2

    problem = image_problem(data)
    if problem:
        raise ValueError(problem)
    width, height = promised_size(data)
    if width * height == 0:
        raise ValueError("cannot be decoded as a PNG or JPEG image; images of other formats must be saved as one")
    if width * height > MOST_PIXELS:
        raise ValueError(f"the image says that it has {width} x {height} pixels; so many are not read")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        # what OpenCV itself finds too large
        image = None
    if image is None:
        raise ValueError("cannot be decoded as an image")
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


def promised_size(data: bytes) -> tuple[int, int]:
    """Width and height in the header of a PNG or JPEG file; 0 and 0 for any other, and where none is found."""
    if data.startswith(PNG_SIGNATURE) and data[12:16] == b"IHDR":
        return int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
    at = len(JPEG_START) if data.startswith(JPEG_START) else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        if data[at + 1] in JPEG_FRAMES:
            return int.from_bytes(data[at + 7 : at + 9]), int.from_bytes(data[at + 5 : at + 7])
        if data[at + 1] in JPEG_WITHOUT_LENGTH:
            # a decoder would go on right behind it, and find another header than is found here
            break
        at += 1 if data[at + 1] == 0xFF else 2 + int.from_bytes(data[at + 2 : at + 4])
    return 0, 0
