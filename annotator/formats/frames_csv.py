"""`frames.csv`: where each frame of a dataset came from, for formats that have no place for it.

One line a frame under the header `id,recording,key,split` (RFC 4180, UTF-8): the frame's id in the dataset (the stem
of its files, or its token), the recording's name, the frame's key in it, and its part of the dataset or nothing.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from annotator.formats.text_folder import read_text
from annotator.types.errors import FormatError

FRAMES_CSV = "frames.csv"
HEADER = ("id", "recording", "key", "split")


@dataclass(frozen=True)
class FrameOrigin:
    """One line of the file.

    Attributes:
        id: of the frame in the dataset.
        recording: name of the recording that it came from.
        key: the frame's key in it.
        split: its part of the dataset; None where that is not divided.
    """

    id: str
    recording: str
    key: str
    split: str | None = None

    @property
    def name(self) -> str:
        """`RECORDING/KEY`, by which a project finds the frame again."""
        return f"{self.recording}/{self.key}"


def dump_frames(origins: Iterable[FrameOrigin]) -> str:
    """The text of the file."""
    stream = io.StringIO()
    # RFC 4180; with "\n" alone a "\r" in a name would not be quoted
    rows = csv.writer(stream, lineterminator="\r\n")
    rows.writerow(HEADER)
    rows.writerows((o.id, o.recording, o.key, o.split or "") for o in origins)
    return stream.getvalue()


def parse_frames(path: Path, text: str) -> dict[str, FrameOrigin]:
    """The lines of the file, by id; `path` is for messages.

    Raises:
        FormatError: another header, a line with too few or too many fields, an empty id or key, or an id that comes
            twice; with the line.
    """
    found: dict[str, FrameOrigin] = {}
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        if (header := tuple(next(rows, ()))) != HEADER:
            raise FormatError(path, f"must begin with {','.join(HEADER)}, not {','.join(header)}", 1)
        for row in rows:
            if len(row) != len(HEADER) or not row[0] or not row[2]:
                raise FormatError(path, f"needs {', '.join(HEADER)} (the last may be empty)", rows.line_num)
            if row[0] in found:
                raise FormatError(path, f"the id {row[0]} is there twice; keep one of its lines", rows.line_num)
            found[row[0]] = FrameOrigin(row[0], row[1], row[2], row[3] or None)
    except csv.Error as error:
        raise FormatError(path, f"is no CSV table: {error}", rows.line_num) from error
    return found


def read_frames(folder: Path) -> dict[str, FrameOrigin]:
    """The origins of a dataset's frames, by id; empty where the dataset has no such file, or one about other things.

    Raises:
        FormatError: as `parse_frames`, or it cannot be read.
    """
    path = folder / FRAMES_CSV
    return parse_frames(path, read_text(path)) if has_frames(folder) else {}


def has_frames(folder: Path) -> bool:
    """True where a folder has the file; other datasets have files of that name about other things.

    Raises:
        FormatError: it cannot be read.
    """
    path = folder / FRAMES_CSV
    if not path.is_file():
        return False
    head = read_text(path).partition("\n")[0]
    # a head that is damaged is still ours, so that reading it says so
    return not head.strip() or "recording" in head.split(",")
