"""The benchmark of linking: its measures, and linking on a real drive."""

from __future__ import annotations

from pathlib import Path

import pytest

from annotator.formats.kitti_rows import read_tracking_labels
from benchmarks.tracks import idf1, measure, switches


def test_idf1_and_switches() -> None:
    # one track split after 4 of 6 boxes, one found completely
    true, found = [1] * 6 + [2] * 4, [7] * 4 + [8] * 2 + [9] * 4
    assert idf1(true, found) == pytest.approx(2 * 8 / 20)
    members = [(n, 0) for n in range(6)] + [(n, 1) for n in range(6, 10)]
    by_member = dict(zip(members, true, strict=True)), dict(zip(members, found, strict=True))
    assert switches(members, *by_member) == 1


@pytest.mark.shared
def test_a_drive_is_linked_without_a_switch(shared: Path) -> None:
    labels = read_tracking_labels(shared / "data" / "kitti_drive_0005" / "label_02.txt", None)
    frames, times = [labels.get(number, []) for number in range(20)], [float(number) for number in range(20)]
    exact = measure(frames, times, False, 0.0, 0.0, 0)
    assert (exact.boxes, exact.tracks, exact.found, exact.idf1, exact.switches) == (61, 4, 4, 1.0, 0)
    noisy = measure(frames, times, False, 0.02, 0.2, 0)
    assert (noisy.found, noisy.idf1, noisy.switches, noisy.smoothed_flipped) == (4, 1.0, 0, 0)
    assert noisy.smoothed_iou > noisy.iou
