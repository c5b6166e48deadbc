"""Boxes of other frames: those of a track, and those of the previous frame, which the recursion can start from."""

from __future__ import annotations

from collections.abc import Sequence

from annotator.project import REVIEWED, Project, StoredFrame
from annotator.project.overview import neighbours
from annotator.rcv.starts import WarmStart
from annotator.tracking.config import TrackingConfig
from annotator.tracking.link import Seen, link
from annotator.types import Label, Proposal


def seeds_of(project: Project, frame: StoredFrame) -> tuple[WarmStart, ...]:
    """Returns the reviewed boxes of the previous frame of the recording, in the order of its labels.

    Empty if there is no previous frame, it has no reviewed box, or the recording is not a sequence.
    """
    return tuple(WarmStart(label.label, label.box) for label in reviewed_before(project, frame))


def reviewed_before(project: Project, frame: StoredFrame) -> tuple[Label, ...]:
    """Returns the labels of `seeds_of`, in the same order."""
    if not project.recordings.get(frame.recording_id).is_sequence:
        return ()
    previous_id = neighbours(project, frame)[0]
    if previous_id is None:
        return ()
    return tuple(label for label in project.labels.of_frame(previous_id) if label.state in REVIEWED)


def followed_tracks(project: Project, frame: StoredFrame, proposals: Sequence[Proposal]) -> list[int | None]:
    """Returns for each proposal of a frame the track id of the previous frame's reviewed box that it continues."""
    tracked = [label for label in reviewed_before(project, frame) if label.track_id is not None]
    ids: list[int | None] = [None] * len(proposals)
    for label, index in zip(tracked, match_proposals(tracked, proposals), strict=True):
        if index is not None:
            ids[index] = label.track_id
    return ids


def match_proposals(labels: Sequence[Label], proposals: Sequence[Proposal]) -> list[int | None]:
    """Returns for each label of a frame the index of the next frame's proposal for the same object, or None."""
    frames = [[Seen(label.label, label.box) for label in labels], [Seen(each.label, each.box) for each in proposals]]
    matches: list[int | None] = [None] * len(labels)
    for track in link(frames, [0.0, 1.0], TrackingConfig()):
        if len(track.members) == 2:
            (_, label_index), (_, proposal_index) = track.members
            matches[label_index] = proposal_index
    return matches


def boxes_of(project: Project, recording_id: int, track_id: int) -> list[tuple[StoredFrame, Label]]:
    """Returns the labels of a track with their frames, in the order of the recording, rejected ones included.

    Raises:
        NotFoundError: no such recording.
    """
    recording = project.recordings.get(recording_id)
    frames = {frame.id: frame for frame in project.frames.of([recording.id])}
    stored = project.labels.select(recordings=[recording.id], tracks=[track_id])
    return [(frames[each.frame_id], each.label) for each in stored]
