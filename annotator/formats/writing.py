"""What every writer of a dataset needs: pictures as bytes, and errors of the disk that name the dataset."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from annotator.types.errors import FormatError

JPEG_QUALITY = 95


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """Turns what the disk says into an error that names the dataset.

    Raises:
        FormatError: in place of an OSError.
    """
    try:
        yield
    except OSError as error:
        raise FormatError(out, f"cannot be written ({error.strerror}); nothing was left behind") from error


def encoded_image(
    rgb: UInt8[np.ndarray, "h w 3"], image_format: Literal["png", "jpg"], jpeg_quality: int = JPEG_QUALITY
) -> bytes:
    """An RGB picture as the bytes of an image file.

    Raises:
        OSError: the format cannot hold it; `writing` names the dataset.
    """
    import cv2

    settings = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if image_format == "jpg" else []
    done, data = cv2.imencode(f".{image_format}", np.ascontiguousarray(rgb[..., ::-1]), settings)
    if not done:
        height_px, width_px = rgb.shape[:2]
        raise OSError(0, f"a picture of {width_px} x {height_px} pixels is too large for a file of type {image_format}")
    return bytes(data.tobytes())
