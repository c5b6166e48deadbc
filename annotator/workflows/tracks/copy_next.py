"""Carries an operator's boxes on: a copy to the next frame, and a correction to the later proposals of the track."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from annotator.geometry.oriented_box import same_box
from annotator.project import REVIEWED, Effort, FramePart, Origin, Project, Receipt, StoredFrame, StoredLabel
from annotator.project.changes import LabelProposed, LabelTracked, Payload
from annotator.project.overview import neighbours, read_page
from annotator.project.sources import covered_by
from annotator.rcv.axes import with_axes_like
from annotator.rcv.follow_object import Look, follow_object
from annotator.tracking.link import TrackingConfig, predicted
from annotator.types import Frame, Label, OrientedBox, ReviewState, Source
from annotator.types.errors import ConfigError, NotFoundError, StaleRevisionError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks.follow_objects import DEFAULTS
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


MIN_SIZE_M = 0.01


def carry_correction(
    project: Project,
    frame_id: int,
    uid: str,
    revision: int,
    was: OrientedBox,
    author: str,
    *,
    effort: Effort | None = None,
) -> tuple[tuple[int, Receipt], ...]:
    """Changes the open proposals of a track after a reviewed box, up to its next reviewed one, as that box was changed.

    Args:
        uid: the reviewed label.
        was: its box before it was corrected.

    Returns:
        The changed frames, in order, with their receipts.

    Raises:
        StaleRevisionError: a frame was changed in the meantime.
        ConfigError: the label is not reviewed, has no track, or is as it was; or no proposal of the track follows.
        NotFoundError: no such frame or label.
    """
    page = read_page(project, frame_id)
    frame = page.frame
    if frame.revision != revision:
        raise StaleRevisionError(f"frame {frame.key}", revision, frame.revision)
    label = next((stored.label for stored in page.labels if stored.label.uid == uid), None)
    if label is None:
        raise NotFoundError(f"frame {frame.key} has no label {uid}; reload the frame")
    if label.state not in REVIEWED:
        raise ConfigError("only a reviewed box says how the later ones are to be corrected; correct this one first")
    if label.track_id is None:
        raise ConfigError("the box belongs to no track; enter a track id, or follow it")
    if same_box(was, label.box):
        raise ConfigError("this box was not corrected, so there is nothing to do alike; correct it first")
    frames = {each.id: each for each in project.frames.of([frame.recording_id])}
    parts: list[FramePart] = []
    for other in project.labels.select(recordings=[frame.recording_id], tracks=[label.track_id]):
        at = frames[other.frame_id]
        if at.index is None or at.index <= (frame.index or 0):
            continue
        if other.label.state in REVIEWED:
            break
        if other.label.state is not ReviewState.PROPOSED or at.finalised:
            continue
        payloads = _corrected(project, at, other, corrected_alike(other.label.box, was, label.box))
        if payloads:
            parts.append(part_of(at, payloads, author, None if parts else effort))
    if not parts:
        raise ConfigError(f"track {label.track_id} has no later proposal to correct before its next reviewed box")
    receipts = project.log.append_to_frames(parts)
    return tuple((part.frame_id, receipt) for part, receipt in zip(parts, receipts, strict=True))


def _corrected(project: Project, frame: StoredFrame, stored: StoredLabel, box: OrientedBox) -> list[Payload]:
    """The events that give an open proposal another box; empty if a reviewed or rejected label covers that box."""
    label = stored.label
    if label.source is Source.AUTO:
        decided = [each for each in project.labels.of_frame(frame.id) if each.state is not ReviewState.PROPOSED]
        if covered_by([replace(label, box=box)], decided) != [None]:
            return []
        # It stays the same proposal, so its score, its doubt and the effort for it stay with it.
        return [project.labels.with_box(label.uid, box)]
    # Of other software's proposals, what it said stays as it is, so the corrected box becomes a proposal of ours.
    new = NewProposal(
        label.label,
        box,
        label.track_id,
        box_kind=label.box_kind,
        attributes=label.attributes,
        said=stored.said,
    )
    return proposal_events(project, frame, [new])


def corrected_alike(box: OrientedBox, was: OrientedBox, now: OrientedBox) -> OrientedBox:
    """Changes a box as another one was changed: turned and moved alike in its own axes, its sides by as many metres.

    Args:
        was, now: the other box before and after.
    """
    turn = was.rotation.T @ now.rotation
    moved_m = was.rotation.T @ (now.center_m - was.center_m)
    turned = OrientedBox.from_parts(box.center_m + box.rotation @ moved_m, box.rotation @ turn, box.size_m)
    # a turn by 90 degrees makes the length the width
    own_m = with_axes_like(box, turned).size_m
    size_m = own_m + now.size_m - with_axes_like(was, now).size_m
    return OrientedBox.from_parts(turned.center_m, turned.rotation, np.maximum(size_m, MIN_SIZE_M))
