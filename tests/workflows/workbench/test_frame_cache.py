"""Opened frames are read once, and the next one is read ahead."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from live_server import wait_until

from annotator.project import NewLabel, Project, WriteContext
from annotator.project import overview as overview_module
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Frame, OrientedBox
from annotator.types.errors import FrameError, NotFoundError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.workbench.frame_cache import FrameCache, OpenFrame
from annotator.workflows.workbench.frame_state import show_frame


@pytest.fixture
def project(people: Project) -> Project:
    return people


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Keys of the frames that are read from the disk, in order."""
    found: list[str] = []
    read = FrameSource.read

    def counted(self: FrameSource, stored: object) -> Frame:
        found.append(vars(stored)["key"])
        return read(self, stored)  # type: ignore[arg-type]

    monkeypatch.setattr(FrameSource, "read", counted)
    return found


def _wait(reads: list[str], count: int) -> None:
    wait_until(lambda: len(reads) >= count)


def test_a_frame_is_read_once_and_the_next_ahead(project: Project, reads: list[str]) -> None:
    cache = FrameCache()
    first = cache.read(project, 1)
    assert cache.read(project, 1) is first
    _wait(reads, 2)
    assert reads == ["000000", "000001"]
    assert cache.read(project, 2).key == "000001"
    _wait(reads, 3)
    assert reads == ["000000", "000001", "000002"]
    cache.close()
    assert cache.read(project, 5).key == "000004", "after the end frames are still read, but not ahead"


def test_an_unreadable_frame_is_an_error_each_time(project: Project, reads: list[str]) -> None:
    cache = FrameCache()
    cache.close()
    project.recordings.rescan(1, ["000000", "gone"])
    gone = project.frames.find(1, "gone").id
    for _ in range(2):
        with pytest.raises(FrameError, match="frame gone no longer exists"):
            cache.read(project, gone)
    with pytest.raises(NotFoundError):
        cache.read(project, 99)


def test_labels_without_new_events_are_not_read_again(
    project: Project, generated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = OpenFrame(open_recording(generated / "people").frame(0))
    frame = project.frames.of()[0].id
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), np.eye(3), np.array([0.5, 0.6, 1.7]))
    project.labels.create(frame, [NewLabel("person", box), NewLabel("person", box)], WriteContext(0, "Ada"))
    reads = Mock(side_effect=overview_module.stored_label)
    monkeypatch.setattr(overview_module, "stored_label", reads)
    first = show_frame(project, frame, opened)
    again = show_frame(project, frame, opened)
    assert reads.call_count == 2 and again.labels is first.labels

    # without an event of the frame, its index and neighbours have changed
    (recording,) = project.recordings.all()
    keys = [stored.key for stored in project.frames.of()]
    project.recordings.rescan(recording.id, ["before", *keys])
    moved = show_frame(project, frame, opened)
    assert (moved.page.frame.index, moved.page.previous) == (1, project.frames.find(recording.id, "before").id)
    assert reads.call_count == 2 and moved.labels is first.labels

    # any event of the frame
    project.boxes.set_on_image(frame, [Box2D("person", 1.0, 2.0, 30.0, 40.0)], BoxKind.BOX, WriteContext(2, "Bob"))
    drawn = show_frame(project, frame, opened)
    assert [item.image_box.xyxy for item in drawn.objects] == [(1.0, 2.0, 30.0, 40.0)]
    project.labels.reject(frame, first.labels[0].stored.label.uid, WriteContext(3, "Bob"))
    rejected = show_frame(project, frame, opened)
    assert rejected.labels[0].stored.label.author == "Bob"
    # what the other label shows is not computed again
    assert rejected.labels[1] is drawn.labels[1] is first.labels[1]
