"""Mask images: the object that each pixel belongs to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from annotator.image_bytes import read_image
from annotator.types.errors import FormatError

SINGLE_OBJECT = 255


def read_mask(path: Path) -> UInt8[np.ndarray, "h w"]:
    """Returns object numbers from 1, in the order of the frame's boxes; 0 is the background.

    A mask of one object may also be stored as 0 and 255; it is returned as 0 and 1.

    Raises:
        FormatError: the file is missing, truncated, or not an 8-bit image with one channel.
    """
    import cv2

    try:
        mask = read_image(path, cv2.IMREAD_UNCHANGED)
    except OSError as error:
        raise FormatError(path, f"the mask cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise FormatError(path, f"is not a valid mask: {error}; write it again") from error
    if mask.ndim != 2 or mask.dtype != np.uint8:
        raise FormatError(path, "a mask must be an 8-bit image with one channel of object numbers")
    if np.isin(mask, (0, SINGLE_OBJECT)).all():
        return (mask == SINGLE_OBJECT).astype(np.uint8)
    return np.asarray(mask)
