"""Some seconds of the soak benchmark: operators on shared frames, and a job."""

from __future__ import annotations

from benchmarks import soak


def test_operators_who_share_frames_see_no_refusal_but_stale_ones() -> None:
    found = soak.run(soak.Arguments(minutes=0.3, operators=4, browsers=0, jobs="export", frames=3))
    assert found["failures"] == []
    assert found["saves"] > 10
    assert found["refused_not_stale"] == 0
    assert found["events"]["frame"] > 10
