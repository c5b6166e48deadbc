"""All boxes of one object."""

from __future__ import annotations

from annotator.project import Project, StoredFrame
from annotator.types import Label


def boxes_of(project: Project, recording_id: int, track_id: int) -> list[tuple[StoredFrame, Label]]:
    """The labels of a track with their frames, in the order of the recording, rejected ones included.

    Raises:
        NotFoundError: no such recording.
    """
    recording = project.recordings.get(recording_id)
    frames = {frame.id: frame for frame in project.frames.of([recording.id])}
    stored = project.labels.select(recordings=[recording.id], tracks=[track_id])
    return [(frames[each.frame_id], each.label) for each in stored]
