"""Corrects the later proposals of a track like one that the operator has corrected: they are wrong for one reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from annotator.geometry.oriented_box import same_box
from annotator.project import REVIEWED, Effort, FramePart, Project, Receipt, StoredFrame, StoredLabel
from annotator.project.log.event_types import Payload
from annotator.project.overview import read_page
from annotator.project.sources import covered_by
from annotator.rcv.axes import with_axes_like
from annotator.types import OrientedBox, ReviewState, Source
from annotator.types.errors import ConfigError, NotFoundError, StaleRevisionError
from annotator.workflows.tracks.propose_boxes import NewProposal, part_of, proposal_events

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
        revision: of its frame, as shown to the operator.
        was: its box before it was corrected.
        author: the operator, who can undo this as one action.
        effort: the operator's effort for this action.

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
