"""`timestamps.csv`: the capture time of each frame of a folder; optional, a format of annotator.

One line per frame under the header `key,timestamp_ns`; whole nanoseconds of any single clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from annotator.file_names import normal
from annotator.files import TABLE_BYTES, read_text_file
from annotator.types.checks import LATEST_NS, too_dense, too_late
from annotator.types.errors import RecordingError
from annotator.types.messages import amount

FILE_NAME = "timestamps.csv"
HEADER = "key,timestamp_ns"
REMEDY = "correct the line, or remove the file to use the frames without times"
LONGEST_TIME = 40
DAY_NS = 86_400 * 10**9
# No sensor takes frames at 10 kHz, but microseconds at 10 Hz have this step. Numbers that are microseconds since 1970
# (of the years 2000 to 2100) may have that of 1 Hz.
MOST_DENSE_NS, MOST_DENSE_US = 100_000, 1_000_000
SINCE_1970_US = (946_684_800 * 10**6, 4_102_444_800 * 10**6)

Times = tuple[int | None, ...]


def line(key: str, timestamp_ns: int) -> str:
    """Returns one line of the file."""
    return f"{key},{timestamp_ns}\n"


def known_times(times_ns: Times) -> Times:
    """Returns the times of frames in order, None for those that are 0: not set by their writer.

    A clock that starts with the recording has 0 once, at its first frame, and the next time within a day.
    """
    unset = [i for i, time in enumerate(times_ns) if time == 0]
    if unset == [0] and len(times_ns) > 1 and 0 < (times_ns[1] or 0) < DAY_NS:
        return times_ns
    return tuple(time or None for time in times_ns)


def read_times(folder: Path, keys: Sequence[str]) -> tuple[Times | None, tuple[str, ...]]:
    """Returns the times of a folder's frames in order, None for frames without one; None without the file. And notes.

    Lines of missing frames are ignored, and times that are not set (`known_times`).

    Raises:
        RecordingError: an invalid header, a line that is not a key and a whole number, a key that occurs twice, or
            times that are hardly nanoseconds.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return None, ()
    try:
        lines = read_text_file(path, TABLE_BYTES).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read ({error}); {REMEDY}") from error
    if not lines or lines[0].strip() != HEADER:
        raise RecordingError(f"{path}:1: the header must be {HEADER}; {REMEDY}")
    times: dict[str, int] = {}
    for number, text in enumerate(lines[1:], 2):
        key, _, time = text.rpartition(",")
        # int() raises for thousands of digits
        if not key or not time.strip().isdecimal() or len(time) > LONGEST_TIME:
            raise RecordingError(
                f"{path}:{number}: must be a key and a time in nanoseconds, not {text[:80]!r}; {REMEDY}"
            )
        if int(time) > LATEST_NS:
            raise RecordingError(f"{path}:{number}: {too_late(time.strip(), 'ns')}; {REMEDY}")
        if normal(key) in times:
            raise RecordingError(f"{path}:{number}: frame {key} already has a line; {REMEDY}")
        times[normal(key)] = int(time)
    written = tuple(times.get(normal(key)) for key in keys)
    known = known_times(written)
    if (problem := _unit_problem(known)) is not None:
        raise RecordingError(
            f"{path}: {problem}; write nanoseconds, or remove the file to use the frames without times"
        )
    unset = sum(time is not None for time in written) - sum(time is not None for time in known)
    note = f"The time of {amount(unset, 'frame')} in {FILE_NAME} is 0, which is taken as unknown."
    return known, (note,) if unset else ()


def _unit_problem(times_ns: Times) -> str | None:
    """Returns what shows that times are in seconds, milliseconds or microseconds; None if nothing does."""
    times = np.unique([time for time in times_ns if time is not None])
    if len(times) < 2:
        return None
    step = float(np.median(np.diff(times)))
    are_us = SINCE_1970_US[0] <= times[0] and times[-1] <= SINCE_1970_US[1]
    return too_dense(step) if step <= (MOST_DENSE_US if are_us else MOST_DENSE_NS) else None
