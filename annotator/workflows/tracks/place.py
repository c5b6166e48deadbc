"""Proposals that an operator asks for, next to what is in a frame already."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from annotator.geometry.iou import iou_3d_matrix
from annotator.project import REVIEWED, Change, Effort, FramePart, Project, StoredFrame, StoredLabel
from annotator.project.overview import read_page
from annotator.project.payloads import LabelDeleted, LabelProposed, Payload
from annotator.project.proposals import SAME_OBJECT_IOU, covered_by
from annotator.project.records import BoxRecord, ProposalRecord
from annotator.types import Label, OrientedBox, Proposal, ReviewState


@dataclass(frozen=True, eq=False)
class Wanted:
    """A box to be proposed.

    Attributes:
        label: class name.
        box: camera frame.
        track_id: of its object, where that is known.
        proposal: with its trace, where the recursion found the box.
    """

    label: str
    box: OrientedBox
    track_id: int | None = None
    proposal: Proposal | None = None


def proposing(project: Project, frame: StoredFrame, wanted: Sequence[Wanted]) -> list[Payload]:
    """The events that propose boxes in a frame; none where there is nothing to propose.

    What people have said stays: a box that a reviewed or rejected label covers already (exact 3D IoU 0.5 or more, or a
    reviewed one of the same track) is left out. Open proposals of the same objects give way.

    Args:
        frame: as it was when its labels were looked at.
    """
    labels = read_page(project, frame.id).labels
    said = [stored.label for stored in labels if stored.label.state is not ReviewState.PROPOSED]
    covers = covered_by(wanted, said)
    new = [w for w, cover in zip(wanted, covers, strict=True) if cover is None and not _is_there(w, said)]
    if not new:
        return []
    gone = [LabelDeleted(uid=stored.label.uid) for stored in labels if _gives_way(stored, new)]
    return [
        *gone,
        *(
            LabelProposed(
                uid=uuid.uuid4().hex,
                label=each.label,
                box=BoxRecord.of(each.box),
                track_id=each.track_id,
                proposal=None if each.proposal is None else ProposalRecord.of(each.proposal),
            )
            for each in new
        ),
    ]


def part_of(frame: StoredFrame, payloads: Sequence[Payload], author: str, effort: Effort | None = None) -> FramePart:
    """What an action says of one frame, based on what was seen of it."""
    return FramePart(frame.id, payloads, Change(frame.revision, author, effort=effort))


def next_track_id(project: Project, recording_id: int) -> int:
    """The lowest id above all of a recording's tracks, from 1."""
    known = [stored.label.track_id for stored in project.labels.select(recordings=[recording_id])]
    return max([0, *(number for number in known if number is not None)]) + 1


def _is_there(wanted: Wanted, said: Sequence[Label]) -> bool:
    own = wanted.track_id
    return own is not None and any(label.track_id == own and label.state in REVIEWED for label in said)


def _gives_way(stored: StoredLabel, new: Sequence[Wanted]) -> bool:
    """True for an open proposal of one of the new boxes' objects, unless somebody gave it another track."""
    label = stored.label
    if label.state is not ReviewState.PROPOSED:
        return False
    is_named = label.track_id is not None and not stored.track_linked
    if any(each.track_id is not None and each.track_id == label.track_id for each in new):
        return True
    same = [each.box for each in new if each.label == label.label]
    return not is_named and bool(same) and float(np.max(iou_3d_matrix([label.box], same))) >= SAME_OBJECT_IOU
