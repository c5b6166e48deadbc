"""Shared by the label readers: handling of faults, finite numbers, and image files."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from annotator.frame_limits import read_frame_file
from annotator.image_bytes import decode_image
from annotator.text import SHOWN, to_number
from annotator.types import BoxKind
from annotator.types.errors import FormatError

OnFault = Callable[[FormatError], None]
"""Called with each fault. If it returns, the faulty entry is skipped and reading continues."""


def raise_fault(fault: FormatError) -> None:
    """Stops reading by raising the fault.

    Raises:
        FormatError: always.
    """
    raise fault


def known_kind(value: object) -> BoxKind | None:
    """Returns what 2D boxes enclose, as annotator writes it; None for anything else, since other tools do not."""
    return next((kind for kind in BoxKind if kind.value == value), None)


def finite_number(text: str, path: Path, line: int, name: str = "") -> float:
    """Returns a text as a finite number.

    Args:
        path, line: for the error message.
        name: the field's name, for the error message.

    Raises:
        FormatError: the text is not a number, or not finite.
    """
    where = f"{name}: " if name else ""
    try:
        value = to_number(text)
    except ValueError as error:
        raise FormatError(path, f"{where}{error}", line) from None
    if not math.isfinite(value):
        raise FormatError(path, f"{where}{text[:SHOWN]!r} is not a finite number", line)
    return value


def read_picture(file: Path) -> tuple[bytes, UInt8[np.ndarray, "h w 3"]]:
    """Returns the bytes of an image file and its pixels: BGR order, rotated according to the EXIF tag.

    Raises:
        FormatError: the file cannot be read, is truncated, damaged, not an image or too large.
    """
    import cv2

    try:
        content = read_frame_file(file)
        return content, decode_image(content, cv2.IMREAD_COLOR)
    except OSError as error:
        raise FormatError(
            file, f"the image cannot be read ({error.strerror}); restore it, or remove its labels"
        ) from error
    except ValueError as error:
        raise FormatError(file, f"is not a readable image: {error}; restore it, or remove its labels") from error
