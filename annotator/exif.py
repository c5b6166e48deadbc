"""EXIF orientation: how an image file asks to be turned or mirrored when it is shown.

Viewers, browsers and most labelling tools turn the image; a camera's calibration and a depth image usually belong to
the pixels as they are stored. One rule for images, their 2D boxes and their masks:

- A size that fits only one of the two, turned or as stored, decides. It comes from the calibration or the label file.
- A depth image of the same camera decides for the pixels as stored, since it has no such tag.
- Otherwise nothing is guessed: it is refused.

Source: CIPA DC-008 (Exif 2.32), 4.6.4, tag Orientation; PNG third edition, 11.3.3.7, eXIf.
"""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np

from annotator.image_bytes import JPEG_SCAN, JPEG_START, PNG_SIGNATURE
from annotator.types import Box2D

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
    tiff = _png_exif(data) if data.startswith(PNG_SIGNATURE) else _jpeg_exif(data)
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


def _jpeg_exif(data: bytes) -> bytes:
    at = len(JPEG_START) if data.startswith(JPEG_START) else len(data)
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != JPEG_SCAN:
        if data[at + 1] == 0xFF:  # fill byte
            at += 1
            continue
        content = data[at + 4 : at + 2 + int.from_bytes(data[at + 2 : at + 4])]
        if data[at + 1] == APP1 and content.startswith(EXIF_MARK):
            return content[len(EXIF_MARK) :]
        at += 2 + int.from_bytes(data[at + 2 : at + 4])
    return b""


def _png_exif(data: bytes) -> bytes:
    at = len(PNG_SIGNATURE)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4])
        if data[at + 4 : at + 8] == b"eXIf":
            return data[at + 8 : at + 8 + length]
        at += 12 + length
    return b""
