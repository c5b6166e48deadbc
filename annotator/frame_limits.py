"""How much memory a frame may take: files of a few kilobytes can declare images and clouds that fill it.

Readers check what a file declares before they decode it. The needs of points and pixels were measured: decoding, and
all that `annotator inspect` and the server do with a frame. `ANNOTATOR_FRAME_MEMORY` raises the limit.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

from annotator.files import read_file
from annotator.types.errors import ConfigError

VARIABLE = "ANNOTATOR_FRAME_MEMORY"
DEFAULT_MIB = 2048
# By default, 16 million points and 67 million pixels.
POINT_BYTES, PIXEL_BYTES = 128, 32


def frame_memory() -> int:
    """Returns the limit in bytes; a ConfigError says that the variable is not a number of MiB."""
    text = os.environ.get(VARIABLE) or str(DEFAULT_MIB)
    if not (text.isascii() and text.isdecimal() and 0 < int(text[:10]) < 2**30):
        raise ConfigError(f"{VARIABLE}={text[:40]!r}: must be a number of MiB, such as {2 * DEFAULT_MIB}")
    return int(text) << 20


def most_pixels() -> int:
    return frame_memory() // PIXEL_BYTES


def memory_problem(*, points: int = 0, pixels: int = 0, more_bytes: int = 0) -> str:
    """Returns why a frame of so many points and pixels is too large, and how to read it; "" if it is not."""
    need, limit = points * POINT_BYTES + pixels * PIXEL_BYTES + more_bytes, frame_memory()
    if need <= limit:
        return ""
    parts = [f"{number} {name}" for number, name in ((points, "points"), (pixels, "pixels")) if number]
    what = " and ".join(parts) or f"{more_bytes} bytes"
    return (
        f"too large: {what} take about {-(-need >> 20)} MiB of memory; the limit is {limit >> 20} MiB "
        f"(the environment variable {VARIABLE} sets another, such as {-(-need >> 20)})"
    )


def require_memory(*, points: int = 0, pixels: int = 0, more_bytes: int = 0) -> None:
    """Raises ValueError if a frame is too large (`memory_problem`)."""
    problem = memory_problem(points=points, pixels=pixels, more_bytes=more_bytes)
    if problem:
        raise ValueError(problem)


def require_pixels(width: int, height: int, *, give_points: bool = False) -> None:
    """Raises ValueError if an image declares no size, or a too large one; `give_points`: each pixel gives a point."""
    if min(width, height) <= 0:
        raise ValueError(f"declares {width} x {height} pixels")
    problem = memory_problem(pixels=width * height, points=width * height * give_points)
    if problem:
        raise ValueError(f"the image of {width} x {height} pixels is {problem}")


def read_frame_file(path: Path) -> bytes:
    """Returns the content of a file of one frame, such as an image or a cloud.

    If it is too large, the OSError says how to read it.
    """
    try:
        return read_file(path, frame_memory())
    except OSError as error:
        if error.errno == errno.EFBIG:
            problem = memory_problem(more_bytes=path.stat().st_size)
            raise OSError(error.errno, problem or error.strerror, str(path)) from error
        raise
