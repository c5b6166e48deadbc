"""The lanes of a recording's timeline."""

from __future__ import annotations

from pathlib import Path

from store_samples import box_at, by_hand, revised

from annotator.project import NewLabel, Project
from annotator.project.lanes import read_lanes
from annotator.types import ReviewState

PROPOSED, REJECTED = ReviewState.PROPOSED, ReviewState.REJECTED


def test_a_track_has_a_span_for_each_run_of_boxes_that_are_alike(project: Project, tmp_path: Path) -> None:
    keys = ["a", "b", "c", "gone", "d", "e", "f"]
    recording = project.recordings.add(tmp_path, "rgbd", "take", keys, True, left_out=["gone"])
    ids = [frame.id for frame in project.frames.of([recording.id]) if frame.index is not None]

    def add(
        place: int, track: int | None, state: ReviewState = ReviewState.ACCEPTED, score: float | None = None
    ) -> str:
        box = NewLabel("hand", box_at(float(place)), track_id=track, state=state, score=score)
        return project.labels.create(ids[place], [box], revised(project, ids[place])).uids[0]

    for place in (1, 2, 3):  # the frame that was left out is no gap
        add(place, 9)
    add(4, 9, PROPOSED, 1.0)
    add(5, 9, PROPOSED, 0.0)
    add(0, 2)
    add(1, 2, REJECTED)
    add(2, 2, PROPOSED)
    # boxes without a track: in a frame, the one with the most doubt counts
    add(3, None)
    add(3, None, PROPOSED, 0.0)
    add(4, None)
    lanes = read_lanes(project.store, recording.id)
    assert list(lanes.frames) == ids
    assert project.frames.numbers(ids) == {frame: place + 1 for place, frame in enumerate(ids)}
    assert [(lane.track_id, lane.spans) for lane in lanes.lanes] == [
        (2, ((0, 0, "hand", 0), (2, 2, "hand", 1))),
        (9, ((1, 3, "hand", 0), (4, 4, "hand", 1), (5, 5, "hand", 4))),
        (None, ((3, 3, None, 4), (4, 4, None, 0))),
    ]
    project.labels.reject(ids[0], project.labels.of_frame(ids[0])[0].uid or "", by_hand(1))
    assert [lane.track_id for lane in read_lanes(project.store, recording.id).lanes] == [9, 2, None]
