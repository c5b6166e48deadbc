"""`timestamps.csv`: when each frame of a folder was taken. A file of ours, and optional.

One line a frame under the header `key,timestamp_ns`; whole nanoseconds on any one clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from annotator.types.errors import RecordingError

FILE_NAME = "timestamps.csv"
HEADER = "key,timestamp_ns"
REMEDY = "correct the line, or remove the file, and the frames have no times"
# As many as a column of the store holds.
MOST_NS = 2**63 - 1

Times = tuple[int | None, ...]


def line(key: str, timestamp_ns: int) -> str:
    """One line of the file."""
    return f"{key},{timestamp_ns}\n"


def read_times(folder: Path, keys: Sequence[str]) -> Times | None:
    """The times of a folder's frames, in their order, None for those that the file does not name; None without a file.

    Lines of frames that are not there (any more) mean nothing.

    Raises:
        RecordingError: another header, a line that is no key and whole number, or a key that comes twice.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return None
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read ({error}); {REMEDY}") from error
    if not lines or lines[0].strip() != HEADER:
        raise RecordingError(f"{path}:1: must begin with {HEADER}; {REMEDY}")
    times: dict[str, int] = {}
    for number, text in enumerate(lines[1:], 2):
        key, _, time = text.rpartition(",")
        if not key or not time.strip().isdecimal() or int(time) > MOST_NS:
            raise RecordingError(f"{path}:{number}: is no key and time in nanoseconds: {text[:80]!r}; {REMEDY}")
        if key in times:
            raise RecordingError(f"{path}:{number}: frame {key} is there already; {REMEDY}")
        times[key] = int(time)
    return tuple(times.get(key) for key in keys)
