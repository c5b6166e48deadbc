"""Folders of KITTI rows, one file a frame: `label_2`, or a detector's results with a score in each row.

The devkit wants a file for every frame, an empty one where nothing was found; so do we.
"""

from __future__ import annotations

from pathlib import Path

from annotator.formats.kitti import DONT_CARE, KittiLabel, parse_label_line
from annotator.formats.text_folder import read_text, text_files
from annotator.types.errors import FormatError

# What rows without a 3D box have in place of its size.
UNKNOWN_SIZE = (-1.0, -1.0, -1.0)


def read_kitti_folder(path: Path, *, scored: bool) -> dict[str, tuple[KittiLabel, ...]]:
    """The rows of every frame, by the file's name without suffix, in file order.

    Args:
        path: a folder, or a zip archive, of `KEY.txt` files.
        scored: True for results: every row must have a score.

    Raises:
        FormatError: as `text_files`; or a row has too few fields, a field that is no finite number, a box whose right
            edge is left of its left one or bottom above its top, or a size that is not positive (-1 -1 -1 says that
            the 3D box is not known).
    """
    return {key: _rows(text, file, scored) for key, file, text in text_files(path)}


def read_kitti_file(path: Path, *, scored: bool) -> tuple[KittiLabel, ...]:
    """The rows of one frame; arguments and errors as of `read_kitti_folder`."""
    return _rows(read_text(path), path, scored)


def _rows(text: str, file: Path, scored: bool) -> tuple[KittiLabel, ...]:
    lines = enumerate(text.splitlines(), 1)
    return tuple(_row(line, file, number, scored) for number, line in lines if line.strip())


def _row(text: str, file: Path, line: int, scored: bool) -> KittiLabel:
    row = parse_label_line(text, file, line)
    if scored and row.score is None:
        raise FormatError(file, "a result has 16 fields, the last a score; this row has 15", line)
    if row.right < row.left or row.bottom < row.top:
        edges = f"{row.left:g} {row.top:g} {row.right:g} {row.bottom:g}"
        raise FormatError(file, f"left top right bottom must be in order, not {edges}", line)
    size = (row.height, row.width, row.length)
    if min(size) <= 0 and size != UNKNOWN_SIZE and row.label.lower() != DONT_CARE.lower():
        height, width, length = size
        raise FormatError(file, f"height width length must be positive, not {height:g} {width:g} {length:g}", line)
    return row
