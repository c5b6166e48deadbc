"""Copies a box to the next frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from annotator.project import REVIEWED, Effort, Origin, Project, StoredFrame
from annotator.project.changes import LabelChanged, NewLabel, Payload
from annotator.project.overview import read_page
from annotator.rcv.follow_object import Look, follow_object
from annotator.tracking.link import MAX_GAP, MOTION_BOXES, predicted
from annotator.types import Frame, Label, OrientedBox
from annotator.types.errors import ConfigError
from annotator.workflows.tracks.propose_boxes import (
    Changed,
    around,
    label_of,
    page_at,
    proposal_events,
    proposal_like,
    why_left_out,
    write,
)
from annotator.workflows.tracks.timeline import Timeline
from annotator.workflows.workbench.drawing_steps import frame_config


@dataclass(frozen=True)
class Copied:
    """The next frame, the uid of the copy there, and the changed frames."""

    frame_id: int
    uid: str
    changed: Changed


def copy_next(
    project: Project,
    frame_id: int,
    uid: str,
    revision: int,
    author: str,
    *,
    read: Callable[[StoredFrame], Frame] | None = None,
    effort: Effort | None = None,
) -> Copied:
    """Proposes a label's box in the next frame, moved along its track, as large as it is.

    A label without a track gets one.

    Args:
        uid: the label, reviewed or not.
        read: reads a frame; the box is then moved and turned with the points inside, if these are found again.
    """
    page = page_at(project, frame_id, revision)
    frame, label = page.frame, label_of(page, uid).label
    timeline = Timeline(project, frame.recording_id)
    if page.next is None:
        raise ConfigError("this is the last frame of its recording; there is no next one")
    next_frame = project.frames.get(page.next)
    if next_frame.finalised:
        raise ConfigError("the next frame is finalised; reopen it first")
    box = _moved(timeline, timeline.index[frame.id], label)
    if read is not None:
        box = _registered(project, label, read(frame), read(next_frame), box)
    is_new = label.track_id is None
    track_id = project.labels.next_track_id(frame.recording_id) if label.track_id is None else label.track_id
    proposal = proposal_like(label, box, track_id, origin=Origin.COPIED)
    events = proposal_events(around(project, next_frame, [proposal]), next_frame, [proposal])
    if not events:
        why = why_left_out(proposal, read_page(project, next_frame.id).labels)
        raise ConfigError(f"nothing was proposed in the next frame: {why}")
    changes: list[tuple[StoredFrame, Sequence[Payload]]] = [(next_frame, events)]
    if is_new:
        changes.append((frame, [LabelChanged(uid=uid, track_id=track_id)]))
    changed = write(project, changes, author, effort, new_tracks=[track_id] if is_new else [])
    copy = next(event.uid for event in events if isinstance(event, NewLabel))
    return Copied(next_frame.id, copy, changed)


def _registered(project: Project, label: Label, here: Frame, there: Frame, expected: OrientedBox) -> OrientedBox:
    """Returns a label's box where its points are found again, or else the expected one."""
    look, config = Look.of(here.cloud.xyz_m, label.box), frame_config(project, there, None)
    found = follow_object(there, expected, look, look, label.label, None, config).proposal
    return expected if found is None else OrientedBox(found.box.pose, label.box.size_m)


def _moved(timeline: Timeline, here: int, label: Label) -> OrientedBox:
    """Returns a label's box moved to the next frame by the motion of its track's last reviewed boxes."""
    if label.track_id is None:
        return timeline.moved(label.box, here, here + 1)
    earlier = {
        timeline.index[other.frame_id]: other.label.box
        for other in timeline.project.labels.along(timeline.recording_id, states=REVIEWED, tracks=[label.track_id])
        if here - MAX_GAP <= timeline.index.get(other.frame_id, here) < here
    }
    known = sorted(earlier)[1 - MOTION_BOXES :]
    boxes = [*(earlier[index] for index in known), label.box]
    boxes = [timeline.moved(box, index, here + 1) for box, index in zip(boxes, [*known, here], strict=True)]
    return predicted(boxes, timeline.times[np.array([*known, here])].tolist(), float(timeline.times[here + 1]))
