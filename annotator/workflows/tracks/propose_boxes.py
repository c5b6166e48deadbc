"""Boxes that come into a frame from elsewhere: as proposals, without changing its reviewed labels."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from annotator.project import REVIEWED, Effort, FramePart, Project, Receipt, StoredFrame, StoredLabel, WriteContext
from annotator.project.changes import LabelChanged, LabelDeleted, NewLabel, Payload
from annotator.project.overview import FramePage, neighbours, read_page
from annotator.project.records import OWN, BoxRecord
from annotator.project.sources import covered_by
from annotator.rcv.starts import WarmStart
from annotator.tracking.link import Seen, link, overlap_at_place
from annotator.types import Label, OrientedBox, Proposal, ReviewState, Source
from annotator.types.errors import NotFoundError, StaleRevisionError
from annotator.workflows.tracks.timeline import Motion

Changed = tuple[tuple[int, Receipt], ...]
"""The changed frames: (frame id, receipt) each."""


Placed = tuple[StoredFrame, OrientedBox, int | None]
"""A box that is to be in a frame, and its track."""


class Surroundings:
    """What is where boxes are to be, before the change: read for all of them together, when it is first needed."""

    def __init__(self, project: Project, boxes: Sequence[Placed]) -> None:
        """
        Args:
            boxes: in frames of one recording.
        """
        self._project, self._boxes = project, boxes

    def labels(self, frame: StoredFrame) -> tuple[StoredLabel, ...]:
        """The labels of a frame that may touch one of the boxes there, or are of its track."""
        return self._labels.get(frame.id, ())

    def is_finalised(self, frame: StoredFrame, stored: StoredLabel) -> bool:
        """Whether a label is in a finalised frame: where it is seen, or where it was made."""
        return frame.finalised or (not stored.is_own and stored.made_in in self._finalised)

    @cached_property
    def kept(self) -> frozenset[str]:
        """Uids of the proposals that no automatic pass replaces."""
        return self._project.labels.kept(*(frame.id for frame, _, _ in self._boxes))

    @cached_property
    def _labels(self) -> dict[int, tuple[StoredLabel, ...]]:
        return self._project.labels.near((frame.id, box, track_id) for frame, box, track_id in self._boxes)

    @cached_property
    def _finalised(self) -> frozenset[int]:
        return self._project.frames.finalised(self._boxes[0][0].recording_id)


def around(project: Project, frame: StoredFrame, boxes: Sequence[NewLabel]) -> Surroundings:
    """The surroundings of new boxes in one frame."""
    return Surroundings(project, [(frame, each.box, each.track_id) for each in boxes])


def proposal_like(label: Label, box: OrientedBox, track_id: int | None, **more: Any) -> NewLabel:
    """A proposal of a label's object at another box, with its class, kind of box and values."""
    values = {"box_kind": label.box_kind, "attributes": label.attributes} | more
    return NewLabel(label.label, box, track_id=track_id, state=ReviewState.PROPOSED, **values)


def proposal_events(
    there: Surroundings, frame: StoredFrame, boxes: Sequence[NewLabel], *, where_rejected: bool = False
) -> list[Payload]:
    """Returns the events that propose boxes in a frame; empty if all boxes are left out.

    A box is left out if its track has a reviewed box in the frame, or if its place is taken: by a reviewed label of its
    class (`overlap_at_place`), by a rejected one (3D IoU 0.5 or more), or by a proposal that a person or a file has
    given another track. Other proposals at its place, or of its track, are replaced; values that a person has set of
    them stay.

    Args:
        there: of the boxes, before the change.
        where_rejected: propose boxes also where a label was rejected.
    """
    labels = there.labels(frame)
    new = _free(_once(boxes), labels, where_rejected=where_rejected)
    # those that were made in the finalised frame of another camera stay
    fixed = [stored for stored in labels if not stored.is_own and there.is_finalised(frame, stored)]
    new = [box for box in new if not any(_is_replaced(stored, [box]) for stored in fixed)]
    if not new:
        return []
    replaced = [stored for stored in labels if _is_replaced(stored, new)]
    values = [
        # as set by a person, so that the new proposal is kept, too
        LabelChanged(uid=each.uid, attributes=dict(stored.label.attributes))
        for stored in replaced
        for each in new
        if stored.label.uid in there.kept and stored.label.label == each.label and _is_replaced(stored, [each])
    ]
    return [*(LabelDeleted(uid=stored.label.uid) for stored in replaced), *new, *values]


def changed_box(
    there: Surroundings,
    frame: StoredFrame,
    stored: StoredLabel,
    *,
    label: str | None = None,
    box: OrientedBox | None = None,
) -> list[Payload]:
    """Returns the events that give a box of a track another class or another 3D box.

    A reviewed one counts as edited. An open proposal stays as it is (no events) where the object is labelled: as
    `proposal_events` says, or it would be where a box was rejected.
    """
    present = stored.label
    given: dict[str, Any] = {} if label is None else {"label": label}
    given |= {} if box is None else {"box": BoxRecord.of(box)}
    if present.state in REVIEWED:
        return [LabelChanged(uid=present.uid, state=ReviewState.EDITED, **given)]
    # Of other software's proposals, what it said stays as it is, so the changed box becomes a proposal of ours.
    said = tuple(each for each in stored.said if each.source != OWN)
    new = replace(present, label=label or present.label)
    proposal = proposal_like(new, present.box if box is None else box, present.track_id, said=said)
    if present.source is not Source.AUTO:
        return proposal_events(there, frame, [proposal])
    # One of ours stays the same proposal, so its score, its doubt and the effort for it stay with it.
    is_free = _free([proposal], there.labels(frame))
    return [LabelChanged(uid=present.uid, **given)] if is_free else []


def page_at(project: Project, frame_id: int, revision: int) -> FramePage:
    """Returns the state of a frame that an operator has seen at a revision; StaleRevisionError if it has changed."""
    page = read_page(project, frame_id)
    if page.frame.revision != revision:
        raise StaleRevisionError("this frame", revision, page.frame.revision)
    return page


def label_of(page: FramePage, uid: str) -> StoredLabel:
    """Returns a label of a frame, as it was when the frame was read."""
    label = next((stored for stored in page.labels if stored.label.uid == uid), None)
    if label is None:
        raise NotFoundError(f"this frame has no label {uid}; reload it")
    return label


def write(
    project: Project,
    changes: Sequence[tuple[StoredFrame, Sequence[Payload]]],
    author: str,
    effort: Effort | None = None,
    *,
    action: str | None = None,
    new_tracks: Collection[int] = (),
) -> Changed:
    """Appends events to several frames, each at its revision, as one action, which has the effort."""
    parts = [
        FramePart(frame.id, events, WriteContext(frame.revision, author, effort=None if number else effort))
        for number, (frame, events) in enumerate(changes)
    ]
    receipts = project.log.append_to_frames(parts, action, new_tracks)
    return tuple((part.frame_id, receipt) for part, receipt in zip(parts, receipts, strict=True))


def blocking(box: NewLabel, labels: Sequence[StoredLabel]) -> Label | None:
    """Returns the label of a frame beside which a box is not proposed, or None.

    That is a reviewed label of its track; or a label of its class at its place, if it is reviewed, or a proposal to
    which a person or a file has given another track.
    """
    for stored in labels:
        label = stored.label
        if label.state in REVIEWED and label.track_id is not None and label.track_id == box.track_id:
            return label
    near = [stored for stored in labels if stored.label.label == box.label and _stays(stored, box)]
    overlaps = overlap_at_place([box.box], [stored.label.box for stored in near])[0]
    return near[int(np.argmax(overlaps))].label if overlaps.any() else None


def _free(boxes: Sequence[NewLabel], labels: Sequence[StoredLabel], *, where_rejected: bool = False) -> list[NewLabel]:
    """Returns the boxes that may be proposed in a frame with these labels."""
    new = [box for box in boxes if blocking(box, labels) is None]
    if where_rejected:
        return new
    rejected = [stored.label for stored in labels if stored.label.state is ReviewState.REJECTED]
    return [box for box, cover in zip(new, covered_by(new, rejected), strict=True) if cover is None]


def why_left_out(box: NewLabel, labels: Sequence[StoredLabel]) -> str:
    """Says why `proposal_events` leaves a box out of a frame with these labels."""
    label = blocking(box, labels)
    if label is None:
        is_free = bool(_free([box], labels))
        return "a proposal is here, in the finalised frame of another camera" if is_free else "a box was rejected here"
    if label.state in REVIEWED:
        return "a reviewed box is here already"
    return f"a proposal of track {label.track_id} is here; if it is the same object, give both one track"


def _stays(stored: StoredLabel, box: NewLabel) -> bool:
    label = stored.label
    if label.state is ReviewState.PROPOSED:
        return label.track_id not in (None, box.track_id) and not stored.track_linked
    return label.state in REVIEWED


def _once(boxes: Sequence[NewLabel]) -> list[NewLabel]:
    """Returns the boxes without those whose track an earlier one has."""
    tracks = [box.track_id for box in boxes]
    return [box for n, box in enumerate(boxes) if box.track_id is None or box.track_id not in tracks[:n]]


def _is_replaced(stored: StoredLabel, new: Sequence[NewLabel]) -> bool:
    """Returns True for an unreviewed proposal of a new box's object, unless an operator gave it another track."""
    label = stored.label
    if label.state is not ReviewState.PROPOSED:
        return False
    has_given_track = label.track_id is not None and not stored.track_linked
    if any(each.track_id is not None and each.track_id == label.track_id for each in new):
        return True
    same_class = [each.box for each in new if each.label == label.label]
    return not has_given_track and bool(overlap_at_place([label.box], same_class).any())


def seeds_of(project: Project, frame: StoredFrame) -> tuple[WarmStart, ...]:
    """Returns the reviewed boxes of the previous frame of the recording, in the order of its labels.

    Empty if there is no previous frame, it has no reviewed box, or the recording is not a sequence.
    """
    return tuple(WarmStart(label.label, label.box) for label in reviewed_before(project, frame))


def reviewed_before(project: Project, frame: StoredFrame) -> tuple[Label, ...]:
    """Returns the labels of `seeds_of`, in the same order, as if they stood still in the world."""
    if not project.recordings.get(frame.recording_id).is_sequence:
        return ()
    previous_id = neighbours(project, frame)[0]
    if previous_id is None:
        return ()
    reviewed = [label for label in project.labels.of_frame(previous_id) if label.state in REVIEWED]
    motion = Motion(project, frame.recording_id, [previous_id, frame.id])
    return tuple(replace(label, box=motion.moved(label.box, previous_id, frame.id)) for label in reviewed)


def followed_tracks(project: Project, frame: StoredFrame, proposals: Sequence[Proposal]) -> list[int | None]:
    """Returns for each proposal of a frame the track id of the previous frame's reviewed box that it continues."""
    tracked = [label for label in reviewed_before(project, frame) if label.track_id is not None]
    ids: list[int | None] = [None] * len(proposals)
    frames = [[Seen(each.label, each.box) for each in boxes] for boxes in (tracked, proposals)]
    for track in link(frames, [0.0, 1.0]):
        if len(track.members) == 2:
            (_, before), (_, now) = track.members
            ids[now] = tracked[before].track_id
    return ids


def boxes_of(project: Project, recording_id: int, track_id: int) -> list[tuple[StoredFrame, Label]]:
    """Returns the labels of a track with their frames, in the order of the recording, rejected ones included."""
    recording = project.recordings.get(recording_id)
    frames = {frame.id: frame for frame in project.frames.of([recording.id])}
    stored = project.labels.along(recording.id, tracks=[track_id])
    return [(frames[each.frame_id], each.label) for each in stored]
