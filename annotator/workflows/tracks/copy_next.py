"""Copies a box to the next frame, moved along its track."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from annotator.project import REVIEWED, Effort, FramePart, Origin, Project, Receipt, StoredFrame, StoredLabel
from annotator.project.event_types import LabelProposed, LabelTracked
from annotator.project.overview import neighbours, read_page
from annotator.rcv.follow_object import Look, follow_object
from annotator.tracking.link import TrackingConfig, predicted
from annotator.types import Frame, Label, OrientedBox
from annotator.types.errors import ConfigError, NotFoundError, StaleRevisionError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks.follow_frames import DEFAULTS
from annotator.workflows.tracks.link import times_of
from annotator.workflows.tracks.propose_boxes import NewProposal, next_track_id, part_of, proposal_events, why_left_out
from annotator.workflows.workbench.drawing_steps import frame_config


@dataclass(frozen=True)
class Copied:
    """The result of copying a box.

    Attributes:
        frame_id: the next frame.
        uid: of the copy.
        changed: the changed frames: (frame id, receipt) each.
    """

    frame_id: int
    uid: str
    changed: tuple[tuple[int, Receipt], ...]


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
        revision: of the frame, as shown to the operator.
        author: the operator, who can undo this as one action.
        read: reads a frame; the box is then moved and turned with the points inside, if these are found again.

    Raises:
        ConfigError: the recording is not a sequence, there is no next frame, it is finalised, or it has this box.
        StaleRevisionError: one of the frames was changed in the meantime.
        TrackTakenError: another object has just been given the label's new track id.
        NotFoundError, RecordingError, FrameError: no such frame or label, or the next frame cannot be read.
    """
    page = read_page(project, frame_id)
    frame = page.frame
    recording = project.recordings.get(frame.recording_id)
    if not recording.is_sequence:
        raise ConfigError(f"the frames of {recording.name} do not follow each other in time; there is no next one")
    if frame.revision != revision:
        raise StaleRevisionError(f"frame {frame.key}", revision, frame.revision)
    stored = next((label for label in page.labels if label.label.uid == uid), None)
    if stored is None:
        raise NotFoundError(f"frame {frame.key} has no label {uid}; reload the frame")
    next_id = neighbours(project, frame)[1]
    if next_id is None:
        raise ConfigError(f"frame {frame.key} is the last of its recording; there is no next frame")
    next_frame = project.frames.get(next_id)
    if next_frame.finalised:
        raise ConfigError(f"frame {next_frame.key} is finalised; reopen it first")
    label = stored.label
    box = _moved(project, frame, stored)
    if read is not None:
        box = _registered(project, label, read(frame), read(next_frame), box)
    is_new = label.track_id is None
    track_id = next_track_id(project, frame.recording_id) if label.track_id is None else label.track_id
    proposal = NewProposal(
        label.label, box, track_id, box_kind=label.box_kind, attributes=label.attributes, origin=Origin.COPIED
    )
    payloads = proposal_events(project, next_frame, [proposal])
    if not payloads:
        why = why_left_out(proposal, read_page(project, next_id).labels)
        raise ConfigError(f"nothing was proposed in frame {next_frame.key}: {why}")
    parts: list[FramePart] = [part_of(next_frame, payloads, author, effort)]
    if is_new:
        parts.append(part_of(frame, [LabelTracked(uid=uid, track_id=track_id)], author))
    receipts = project.log.append_to_frames(parts, new_tracks=[track_id] if is_new else [])
    changed = tuple((part.frame_id, receipt) for part, receipt in zip(parts, receipts, strict=True))
    copy = next(payload.uid for payload in payloads if isinstance(payload, LabelProposed))
    return Copied(next_frame.id, copy, changed)


def _registered(project: Project, label: Label, here: Frame, there: Frame, expected: OrientedBox) -> OrientedBox:
    """Returns a label's box where its points are found again, or else the expected one."""
    look, config = Look.of(here.cloud.xyz_m, label.box), frame_config(project, there, None)
    found = follow_object(there, expected, look, look, label.label, None, config, DEFAULTS).proposal
    return expected if found is None else OrientedBox(found.box.pose, label.box.size_m)


def _moved(project: Project, frame: StoredFrame, stored: StoredLabel) -> OrientedBox:
    """Returns a label's box moved to the next frame by the motion of its track's last reviewed boxes."""
    label = stored.label
    if label.track_id is None:
        return label.box
    frames = [each for each in project.frames.of([frame.recording_id]) if each.index is not None]
    indices = {each.id: index for index, each in enumerate(frames)}
    here, config = indices[frame.id], TrackingConfig()
    earlier = {
        indices[other.frame_id]: other.label.box
        for other in project.labels.select(states=REVIEWED, recordings=[frame.recording_id], tracks=[label.track_id])
        if here - config.max_gap <= indices.get(other.frame_id, here) < here
    }
    known = sorted(earlier)[1 - config.motion_boxes :]
    times = times_of(FrameSource(project).recording(frame.recording_id), frames)
    boxes = [*(earlier[index] for index in known), label.box]
    return predicted(boxes, times[np.array([*known, here])].tolist(), float(times[here + 1]))
