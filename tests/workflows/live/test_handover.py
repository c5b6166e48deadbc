"""Frames are requested shortly before the detection needs them; the test sets the clock."""

from __future__ import annotations

import threading

import pytest

from annotator.workflows.live import pipeline
from annotator.workflows.live.pipeline import SPARE_S, Demand


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(pipeline.time, "perf_counter", lambda: now[0])
    return now


def test_the_next_frame_is_requested_shortly_before_the_detection_ends(clock: list[float]) -> None:
    wanted = Demand()
    assert wanted._left_s() <= 0
    for _ in range(3):
        wanted.frame_read(read_s=0.01)
        assert wanted._left_s() == float("inf"), "a frame is already available"
        wanted.detection_begins()
        clock[0] += 0.06
        wanted.detection_ends()
        assert wanted._left_s() <= 0, "the detection is idle"
    wanted.frame_read(read_s=0.01)
    wanted.detection_begins()
    assert wanted._left_s() == pytest.approx(0.06 - 0.01 - SPARE_S)
    clock[0] += 0.05
    assert wanted._left_s() < 0


def test_before_the_first_detection_has_ended_frames_are_requested_at_once(clock: list[float]) -> None:
    wanted = Demand()
    wanted.frame_read(read_s=0.01)
    wanted.detection_begins()
    assert wanted._left_s() <= 0


@pytest.mark.parametrize("wake", ["detection_begins", "close"])
def test_a_waiting_thread_is_woken(wake: str) -> None:
    wanted = Demand()
    wanted.frame_read(read_s=0.01)
    waits = threading.Thread(target=wanted.wait)
    waits.start()
    waits.join(0.05)
    assert waits.is_alive()
    getattr(wanted, wake)()
    waits.join(30.0)
    assert not waits.is_alive()
