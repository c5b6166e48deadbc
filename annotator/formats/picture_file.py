"""Picture files that somebody else brings: read bounded, decoded strictly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from annotator.files import read_at_most
from annotator.pictures import decode_picture
from annotator.types.errors import FormatError

# The largest cameras' pictures have a few hundred megabytes where nothing is compressed.
MAX_PICTURE_BYTES = 512 * 2**20


def read_picture(file: Path) -> tuple[bytes, UInt8[np.ndarray, "h w 3"]]:
    """The bytes of a picture file, and the picture: BGR order, turned as the camera's tag says.

    Raises:
        FormatError: it cannot be read, is cut off, damaged or no picture, or is too large.
    """
    import cv2

    try:
        content = read_at_most(file, MAX_PICTURE_BYTES)
        if len(content) > MAX_PICTURE_BYTES:
            raise ValueError(f"the file is longer than {MAX_PICTURE_BYTES // 2**20} MiB")
        return content, decode_picture(content, cv2.IMREAD_COLOR)
    except OSError as error:
        raise FormatError(
            file, f"the picture cannot be read ({error.strerror}); bring it back, or remove it"
        ) from error
    except ValueError as error:
        raise FormatError(file, f"is no picture that can be read: {error}; bring it back, or remove it") from error
