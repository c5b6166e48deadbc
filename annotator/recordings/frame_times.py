"""The times of a recording's frames, without reading the frames; and `timestamps.csv`, the times of a folder's frames.

The file is optional, a format of annotator: one line per frame under the header `key,timestamp_ns`; whole nanoseconds
of any single clock.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from annotator.files import TABLE_BYTES, read_text_file
from annotator.recordings.listing import file_errors
from annotator.recordings.recording import Recording
from annotator.text import normal
from annotator.types.checks import LATEST_NS, too_late
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
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return None, ()
    with file_errors(path, REMEDY, kind=RecordingError):
        lines = read_text_file(path, TABLE_BYTES).splitlines()
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
    if (problem := unit_problem(known)) is not None:
        raise RecordingError(
            f"{path}: {problem}; write nanoseconds, or remove the file to use the frames without times"
        )
    unset = sum(time is not None for time in written) - sum(time is not None for time in known)
    note = f"The time of {amount(unset, 'frame')} in {FILE_NAME} is 0, which is taken as unknown."
    return known, (note,) if unset else ()


def unit_problem(times_ns: Iterable[int | None]) -> str | None:
    """Returns what shows that times are in seconds, milliseconds or microseconds; None if nothing does."""
    times = np.unique([time for time in times_ns if time is not None])
    if len(times) < 2:
        return None
    step = float(np.median(np.diff(times)))
    are_us = SINCE_1970_US[0] <= times[0] and times[-1] <= SINCE_1970_US[1]
    if step > (MOST_DENSE_US if are_us else MOST_DENSE_NS):
        return None
    return f"the times are {step:g} ns apart (their median), so their unit is probably another one"


def recorded_times(recording: Recording) -> dict[str, int | None] | None:
    """The time of each frame by its key, nanoseconds on an arbitrary clock; None if the recording has no times."""
    times_ns: Times | None = getattr(recording, "times_ns", None)
    return None if times_ns is None else dict(zip(recording.keys, times_ns, strict=True))


def has_times(recording: Recording) -> bool:
    """True if the recording is a sequence with at least two times, so that images and clouds may be apart in time."""
    times = recorded_times(recording) if recording.is_sequence else None
    return times is not None and sum(time is not None for time in times.values()) > 1


def nearest(of_ns: Int64[np.ndarray, "n"], among_ns: Int64[np.ndarray, "m"]) -> Int64[np.ndarray, "n"]:
    """Returns for each time the number of the nearest of `among_ns`, the earlier one of two; m > 0, in any order."""
    order = np.argsort(among_ns, kind="stable")
    ordered = among_ns[order]
    after = np.clip(np.searchsorted(ordered, of_ns), 1, max(len(ordered) - 1, 1))
    if len(ordered) == 1:
        return np.zeros(len(of_ns), np.int64)
    is_before = of_ns - ordered[after - 1] <= ordered[after] - of_ns
    return np.asarray(order[np.where(is_before, after - 1, after)])


def image_at(recording: Recording, index: int, offset_s: float) -> int:
    """Index of the frame whose image belongs to the cloud of frame `index`, with the clouds' clock ahead by `offset_s`.

    It is the frame itself without a time for it, or where no other image is nearer in time.
    """
    times: Times | None = getattr(recording, "times_ns", None) if recording.is_sequence else None
    time_ns = None if times is None else times[index]
    if times is None or time_ns is None:
        return index
    known = [i for i, time in enumerate(times) if time is not None]
    wanted_ns, known_ns = time_ns - round(offset_s * 1e9), np.array([times[i] for i in known])
    near = int(nearest(np.array([wanted_ns]), known_ns)[0])
    return index if abs(time_ns - wanted_ns) <= abs(int(known_ns[near]) - wanted_ns) else known[near]
