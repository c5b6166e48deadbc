"""Times of frames: `timestamps.csv`, times that are not set, and which image belongs to a cloud when clocks differ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from annotator.recordings import open_recording
from annotator.recordings.frame_times import has_times, known_times, read_times, recorded_times
from annotator.types.errors import RecordingError

EPOCH, STEP = 1_700_000_000_000_000_000, 100_000_000
TABLE = [
    pytest.param((0, STEP, 2 * STEP), (0, STEP, 2 * STEP), id="start"),
    pytest.param((0, 0, 0), (None, None, None), id="all"),
    pytest.param((0,), (None,), id="only"),
    pytest.param((EPOCH, 0, EPOCH + STEP), (EPOCH, None, EPOCH + STEP), id="one"),
    pytest.param((0, EPOCH, EPOCH + STEP), (None, EPOCH, EPOCH + STEP), id="first"),
    pytest.param((0, None, STEP), (None, None, STEP), id="before a gap"),
]


@pytest.mark.parametrize(("written", "known"), TABLE)
def test_times_of_0_are_unknown(tmp_path: Path, written: tuple[int | None, ...], known: tuple[int | None, ...]):
    assert known_times(written) == known
    lines = [f"{key},{time}\n" for key, time in enumerate(written) if time is not None]
    (tmp_path / "timestamps.csv").write_text("key,timestamp_ns\n" + "".join(lines))
    for key in range(len(written)):
        np.save(tmp_path / f"{key}.npy", np.random.default_rng(key).uniform(2, 9, (20, 3)))
    recording = open_recording(tmp_path)
    assert tuple((recorded_times(recording) or {}).values()) == known
    assert tuple(recording.frame(i).timestamp_ns for i in range(len(written))) == known
    assert has_times(recording) == (sum(time is not None for time in known) > 1)
    told = [note for note in recording.notes if "which is taken as unknown" in note]
    assert len(told) == (written != known)


# Unit in nanoseconds, frames per second, start in seconds, and the step that is told; None: they are read.
UNITS = [
    *(
        (unit, rate, start, 1e9 / rate / unit)
        for unit in (10**9, 10**6, 10**3)
        for rate, start in ((1, 1.7e9), (25, 0.5))
    ),
    # nanoseconds, also of a computer that has run for 20 days, and of fast sensors
    *((1, rate, start, None) for rate in (0.1, 30, 500) for start in (0.5, 20 * 86_400, 1.7e9)),
]


@pytest.mark.parametrize(("unit_ns", "rate", "start_s", "step"), UNITS)
def test_times_in_another_unit_are_refused(
    tmp_path: Path, unit_ns: int, rate: float, start_s: float, step: float | None
):
    start, step_ns = round(start_s * 1e9), round(1e9 / rate)
    times = [(start + number * step_ns) // unit_ns for number in range(40)]
    (tmp_path / "timestamps.csv").write_text(
        "key,timestamp_ns\n" + "".join(f"{number:02},{time}\n" for number, time in enumerate(times))
    )
    keys = [f"{number:02}" for number in range(40)]
    if step is None:
        assert read_times(tmp_path, keys) == (tuple(times), ())
        return
    with pytest.raises(RecordingError, match=r"timestamps\.csv: the times are .*so their unit is probably") as caught:
        read_times(tmp_path, keys)
    told = float(str(caught.value).split("the times are ")[1].split()[0])
    assert told == pytest.approx(max(step, 1), rel=0.02, abs=0.51)


def test_lists_of_tum_without_times_are_an_error(tmp_path: Path):
    for name in ("rgb", "depth"):
        (tmp_path / f"{name}.txt").write_text(f"0 {name}/1.png\n0.0 {name}/2.png\n1 {name}/3.png\n")
    with pytest.raises(RecordingError, match=r"rgb\.txt: the time of 2 images is 0"):
        open_recording(tmp_path)
