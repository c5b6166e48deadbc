"""The frame state shown by a page: only changed parts are read again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from annotator.project import NewLabel, Project, WriteContext
from annotator.project import overview as overview_module
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, OrientedBox
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.frame_state import show_frame


def test_labels_without_new_events_are_not_read_again(
    make_project: Callable[..., Project], generated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = make_project(generated / "people")
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
