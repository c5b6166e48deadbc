"""The store stays out of the way: generous limits that only a wrong kind of work would break."""

from __future__ import annotations

import time
from pathlib import Path

from store_samples import by_machine, proposal_at

from annotator.project import Project, RunShare


def test_ten_thousand_frames(project: Project, tmp_path: Path) -> None:
    start = time.perf_counter()
    project.recordings.add(tmp_path / "long", "rgbd", "long", [f"{n:06d}" for n in range(10_000)], True)
    assert time.perf_counter() - start < 2.0
    run = project.jobs.start(image_detector="a", view_detector="b", config_json="{}")
    for frame in project.frames.of()[:50]:
        project.proposals.replace(frame.id, [proposal_at()], by_machine(), run=RunShare(run.id, 0.1))
    start = time.perf_counter()
    assert len(project.jobs.pending(run.key)) == 9_950
    project.statistics()
    assert time.perf_counter() - start < 2.0


def test_events_are_appended_quickly(project: Project, tmp_path: Path) -> None:
    recording = project.recordings.add(tmp_path / "long", "rgbd", "long", [str(n) for n in range(100)], True)
    proposals = [proposal_at(5.0 * n, steps=3, views=8) for n in range(3)]
    start = time.process_time()
    for frame in project.frames.of([recording.id]):
        project.proposals.replace(frame.id, proposals, by_machine())
    assert (time.process_time() - start) / 100 < 0.1, "processor seconds a frame"
