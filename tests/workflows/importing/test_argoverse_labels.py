"""The annotations of an Argoverse 2 log become labels of each camera's frames, or proposals."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from argoverse_samples import CAMERAS, write_log

from annotator.geometry.oriented_box import box_corners
from annotator.project import Project
from annotator.recordings import ReaderOptions, open_recording
from annotator.types.errors import FormatError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.importing import BoxFormat, Note, format_of, import_labels, import_proposals, read_labels
from annotator.workflows.recorded.reading import load_truth

AHEAD, BEHIND = "REGULAR_VEHICLE", "PEDESTRIAN"


def test_annotations_are_placed_like_the_recordings_own(make_project: Callable[..., Project], tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", sweeps=3)
    file = write_log(tmp_path / "theirs", sweeps=4, images=False) / "annotations.feather"
    assert format_of(file) is format_of(file.parent) is BoxFormat.ARGOVERSE2
    project = make_project(classes=(AHEAD, BEHIND))
    with pytest.raises(FormatError, match=r"none of its sweeps \(4\); add their log"):
        import_labels(project, read_labels(BoxFormat.ARGOVERSE2, file))
    recordings = [open_recording(log, ReaderOptions(camera=camera)) for camera in CAMERAS]
    register_recording(project, recordings[0], options=ReaderOptions(camera=next(iter(CAMERAS))))
    done = import_labels(project, read_labels(BoxFormat.ARGOVERSE2, file))
    # the front camera sees one of the two boxes of each sweep
    assert (done.frames, done.boxes, done[Note.UNSEEN], len(tuple(done.of(Note.UNMATCHED)))) == (3, {AHEAD: 3}, 3, 1)
    for number, stored in enumerate(project.frames.of()):
        (label,) = project.labels.of_frame(stored.id)
        (own,) = load_truth(recordings[0], number, recordings[0].frame(number))
        np.testing.assert_allclose(box_corners(label.box), box_corners(own.box), atol=1e-9)
        assert (label.label, label.track_id) == (own.label, own.track_id)
    register_recording(project, recordings[1], options=ReaderOptions(camera=list(CAMERAS)[1]))
    proposed = import_proposals(project, read_labels(BoxFormat.ARGOVERSE2, file.parent))
    assert (proposed.frames, proposed.boxes, proposed[Note.COVERED], proposed[Note.UNSEEN]) == (6, {BEHIND: 3}, 3, 0)
