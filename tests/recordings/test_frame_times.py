"""`timestamps.csv`: times of 0 are not set, except for the start of a clock."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from annotator.recordings import open_recording
from annotator.recordings.frame_times import known_times
from annotator.recordings.times import has_times, recorded_times
from annotator.types.errors import RecordingError

EPOCH, STEP = 1_700_000_000_000_000_000, 100_000_000
TABLE = [
    pytest.param((0, STEP, 2 * STEP), (0, STEP, 2 * STEP), id="start"),
    pytest.param((0, 0, 0), (None, None, None), id="all"),
    pytest.param((0,), (None,), id="only"),
    pytest.param((EPOCH, 0, EPOCH + STEP), (EPOCH, None, EPOCH + STEP), id="one"),
    pytest.param((0, EPOCH, EPOCH + STEP), (None, EPOCH, EPOCH + STEP), id="first"),
    pytest.param((0, None, STEP), (None, None, STEP), id="before a gap"),
    pytest.param((0, STEP, 0), (None, STEP, None), id="two"),
    pytest.param((None, EPOCH), (None, EPOCH), id="none"),
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


def test_lists_of_tum_without_times_are_an_error(tmp_path: Path):
    for name in ("rgb", "depth"):
        (tmp_path / f"{name}.txt").write_text(f"0 {name}/1.png\n0.0 {name}/2.png\n1 {name}/3.png\n")
    with pytest.raises(RecordingError, match=r"rgb\.txt: the time of 2 images is 0"):
        open_recording(tmp_path)
