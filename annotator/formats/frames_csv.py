"""`frames.csv`: the origin of each frame of a dataset, for formats that cannot store it.

One line per frame under the header `id,recording,key,split` (RFC 4180, UTF-8): the frame's id in the dataset (the stem
of its files, or its token), the recording's name, the frame's key in the recording, and its part of the dataset (may be
empty). A text that a spreadsheet would run as a formula begins with an apostrophe, which the reader removes.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from annotator.formats.text_folder import read_text
from annotator.text import normal
from annotator.types.errors import FormatError

FRAMES_CSV = "frames.csv"
HEADER = ("id", "recording", "key", "split")

# Apostrophes before such a beginning are doubled, so that every text is read back as it was.
_FORMULA = re.compile(r"'*[=+\-@\t\r\n]")
_ESCAPED = re.compile(r"^'(?='*[=+\-@\t\r\n])")
_NUMBER = re.compile(r"[+-]?[0-9]+(\.[0-9]*)?([eE][+-]?[0-9]+)?")


@dataclass(frozen=True)
class FrameOrigin:
    """One line of the file.

    Attributes:
        id: the frame's id in the dataset.
        recording: name of the recording that the frame came from.
        key: the frame's key in that recording.
        split: its part of the dataset; None for a dataset without parts.
    """

    id: str
    recording: str
    key: str
    split: str | None = None

    @property
    def name(self) -> str:
        """`RECORDING/KEY`, which identifies the frame in a project."""
        return f"{self.recording}/{self.key}"


def dump_frames(origins: Iterable[FrameOrigin]) -> str:
    """Returns the text of the file."""
    stream = io.StringIO()
    # RFC 4180; with "\n" alone the csv module would not quote a "\r" in a name
    rows = csv.writer(stream, lineterminator="\r\n")
    rows.writerow(HEADER)
    rows.writerows(map(_escaped, (o.id, o.recording, o.key, o.split or "")) for o in origins)
    return stream.getvalue()


def _escaped(cell: str) -> str:
    return f"'{cell}" if _FORMULA.match(cell) and not _NUMBER.fullmatch(cell) else cell


def parse_frames(path: Path, text: str) -> dict[str, FrameOrigin]:
    """Returns the lines of the file, by `normal` id; `path` is for error messages.

    Raises:
        FormatError: a wrong header, a line with too few or too many fields, an empty id or key, or an id that occurs
            twice; names the line.
    """
    origins: dict[str, FrameOrigin] = {}
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        if (header := tuple(next(rows, ()))) != HEADER:
            raise FormatError(path, f"must begin with {','.join(HEADER)}, not {','.join(header)}", 1)
        for row in ([_ESCAPED.sub("", cell) for cell in row] for row in rows):
            if len(row) != len(HEADER) or not row[0] or not row[2]:
                raise FormatError(
                    path, f"needs the fields {', '.join(HEADER)}; id and key must not be empty", rows.line_num
                )
            if normal(row[0]) in origins:
                raise FormatError(path, f"the id {row[0]} occurs twice; keep one of its lines", rows.line_num)
            origins[normal(row[0])] = FrameOrigin(row[0], row[1], row[2], row[3] or None)
    except csv.Error as error:
        raise FormatError(path, f"is not valid CSV: {error}", rows.line_num) from error
    return origins


def read_frames(folder: Path) -> dict[str, FrameOrigin]:
    """Returns the origins of a dataset's frames, by `normal` id; empty if it has no such file or an unrelated one.

    Raises:
        FormatError: as `parse_frames`, or the file cannot be read.
    """
    path = folder / FRAMES_CSV
    return parse_frames(path, read_text(path)) if has_frames(folder) else {}


def has_frames(folder: Path) -> bool:
    """True if a folder has the file; a `frames.csv` with an unrelated header does not count.

    Raises:
        FormatError: the file cannot be read.
    """
    path = folder / FRAMES_CSV
    if not path.is_file():
        return False
    head = read_text(path).partition("\n")[0]
    # a damaged header still counts, so that reading the file reports it
    return not head.strip() or "recording" in head.split(",")
