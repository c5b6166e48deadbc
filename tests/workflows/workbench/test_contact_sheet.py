"""Contact sheets: the picture of a box, and accepting proposals of several frames as one action."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from annotator.project import Effort, Project, StoredFrame, WriteContext, create_project
from annotator.recordings import open_recording
from annotator.types import Box2D, Frame, OrientedBox, Proposal, Quality, ReviewState, Source
from annotator.types.errors import ConfigError, NotFoundError, StaleRevisionError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.workbench.contact_sheet import (
    FRONT,
    GAP,
    GAP_PX,
    LINE,
    VIEW_PX,
    SeenBox,
    SheetPictures,
    accept_boxes,
    picture,
)
from annotator.workflows.workbench.frame_cache import FrameCache


@pytest.fixture
def project(generated: Path, tmp_path: Path) -> Project:
    made = create_project(tmp_path, "room", ["person"])
    register_recording(made, open_recording(generated / "people"))
    for frame in made.frames.of():
        propose(made, frame)
    return made


def propose(project: Project, frame: StoredFrame) -> None:
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), np.eye(3), np.array([0.8, 0.5, 1.7]))
    proposal = Proposal("person", 0.8, box, Box2D("person", 1.0, 2.0, 30.0, 40.0), (), Quality(0.1, 0.9, 0.1))
    project.proposals.replace(frame.id, [proposal], WriteContext(frame.revision, "rcv", Source.AUTO))


def seen(project: Project) -> list[SeenBox]:
    return [
        SeenBox(frame.id, frame.revision, label.uid)
        for frame in project.frames.of()
        for label in project.labels.of_frame(frame.id)
    ]


def states(project: Project) -> list[ReviewState]:
    return [project.labels.get(each.uid).label.state for each in seen(project)]


def test_a_picture_shows_three_views_and_the_box_on_them(generated: Path) -> None:
    recording = open_recording(generated / "people")
    frame = recording.frame(0)
    box = load_truth(recording, 0, frame)[0].box
    strip = picture(frame, box)
    assert strip.shape == (VIEW_PX, 3 * VIEW_PX + 2 * GAP_PX, 3)
    assert (strip[:, VIEW_PX : VIEW_PX + GAP_PX] == GAP).all()
    front = strip[:, VIEW_PX + GAP_PX : 2 * VIEW_PX + GAP_PX]
    rows, columns = np.nonzero((front == LINE).all(axis=2))
    # the view is 1.7 times as wide as its longer side, and the box is in its middle
    scale = VIEW_PX / (1.7 * box.size_m[1:].max())
    assert np.ptp(columns) == pytest.approx(scale * box.size_m[1], abs=1.5)
    assert np.ptp(rows) == pytest.approx(scale * box.size_m[2], abs=1.5)
    assert rows.min() + rows.max() == pytest.approx(VIEW_PX - 1, abs=2)
    # the front is up in the top view, on the right in that of the right side
    top, side = strip[:, :VIEW_PX], strip[:, 2 * (VIEW_PX + GAP_PX) :]
    for part, axis, (marked, others) in ((top, 0, (0, 95)), (side, 1, (95, 0))):
        edge, outline = (np.nonzero((part == color).all(axis=2))[axis] for color in (FRONT, LINE))
        assert np.ptp(edge) == 1 and len(edge) > 20
        assert abs(edge.mean() - marked) < abs(edge.mean() - others)
        assert abs(outline.mean() - others) < abs(edge.mean() - others)
    assert not (front == FRONT).all(axis=2).any()
    moved = OrientedBox.from_parts(box.center_m + np.array([0, 0, 40.0]), box.rotation, box.size_m)
    assert (picture(frame, moved) == LINE).all(axis=2).any(), "a box without points has a picture, too"


def test_boxes_of_several_frames_are_accepted_and_undone_together(project: Project) -> None:
    *right, wrong = seen(project)
    receipts = accept_boxes(project, right, "Ada", Effort(3, 12.0))
    assert [frame for frame, _ in receipts] == [each.frame_id for each in right]
    assert states(project) == [ReviewState.ACCEPTED] * len(right) + [ReviewState.PROPOSED]
    efforts = [event.effort for each in right for event in project.log.of_frame(each.frame_id) if event.effort]
    assert efforts == [Effort(3, 12.0)], "the effort is counted once"
    revision = project.frames.get(wrong.frame_id).revision
    assert revision == wrong.revision
    project.history.undo("Ada")
    assert set(states(project)) == {ReviewState.PROPOSED}


def test_what_has_changed_since_is_refused_and_nothing_is_stored(project: Project) -> None:
    boxes = seen(project)
    last = boxes[-1]
    project.labels.reject(last.frame_id, last.uid, WriteContext(last.revision, "Ben"))
    with pytest.raises(ConfigError, match="open the sheet again"):
        accept_boxes(project, boxes, "Ada")
    stale = [*boxes[:-2], SeenBox(boxes[-2].frame_id, boxes[-2].revision - 1, boxes[-2].uid)]
    with pytest.raises(StaleRevisionError):
        accept_boxes(project, stale, "Ada")
    with pytest.raises(NotFoundError):
        accept_boxes(project, [SeenBox(1, 1, "0" * 32)], "Ada")
    with pytest.raises(ConfigError, match="no box is chosen"):
        accept_boxes(project, [], "Ada")
    assert set(states(project)[:-1]) == {ReviewState.PROPOSED}


def test_pictures_of_proposals_are_drawn_ahead_and_only_once(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = FrameCache()
    sheets = SheetPictures(frames)
    looked: list[int] = []
    look = frames.look

    def counted(project: Project, stored: StoredFrame) -> Frame:
        looked.append(stored.id)
        return look(project, stored)

    monkeypatch.setattr(frames, "look", counted)
    (recording,) = project.recordings.all()
    sheets.prepare(project, recording.id)
    deadline = time.monotonic() + 60
    while len(looked) < 5 and time.monotonic() < deadline:
        time.sleep(0.01)
    shown = [(frame, label.box) for frame in project.frames.of() for label in project.labels.of_frame(frame.id)]
    pictures = [sheets.get(project, frame, box) for frame, box in shown[:-1]]
    assert all(content.startswith(b"\x89PNG") for content in pictures)
    assert looked == [frame.id for frame in project.frames.of()]
    frame, box = shown[0]
    moved = OrientedBox.from_parts(box.center_m + 0.1, box.rotation, box.size_m)
    assert sheets.get(project, frame, moved) != pictures[0]
    sheets.close()
    frames.close()
