"""Proposals of automatic passes: each pass replaces the unreviewed labels and keeps the reviewed ones."""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.spatial.transform import RigidTransform
from sqlalchemy import select

from annotator.geometry.iou import iou_3d_matrix
from annotator.project.adjusting.moving import Moves
from annotator.project.event_types import ProposalsReplaced, ProposedObject
from annotator.project.events import Event, event_of
from annotator.project.jobs import read_run, record_result
from annotator.project.labels import read_labels
from annotator.project.records import BoxRecord, ProposalRecord, parsed, storable
from annotator.project.schema import events, frames, labels
from annotator.project.writing import Receipt, WriteContext, Writer, require_writable
from annotator.types import BoxKind, Label, LostObject, OrientedBox, Proposal, ReviewState
from annotator.types.errors import RESTORE, ProjectError

# Minimum exact 3D IoU at which a proposal and a label of one class count as the same object.
SAME_OBJECT_IOU = 0.5


@dataclass(frozen=True)
class RunShare:
    """One frame's share of a batch run: the run's id, and the frame's processing time in seconds."""

    run_id: int
    seconds: float


@dataclass(frozen=True)
class Replaced:
    """Result of an automatic pass.

    Attributes:
        uids: of the new labels, in the proposals' order; None for a proposal that a reviewed label covers.
        covered: number of covered proposals.
        receipt: of the write.
    """

    uids: tuple[str | None, ...]
    covered: int
    receipt: Receipt


@dataclass(frozen=True, eq=False)
class PassObject:
    """One proposal of a pass.

    Attributes:
        uid: of the label created from it.
        covered_by: uid of the reviewed label of the same object; if set, no label was created.
        proposal: with its whole trace.
    """

    uid: str
    covered_by: str | None
    proposal: Proposal


@dataclass(frozen=True, eq=False)
class Pass:
    """One automatic pass over one frame.

    Attributes:
        event_id, author, time_ns: of its event.
        run_id: the batch run, if it was part of one.
        objects: all proposals.
        lost: frustums without a resulting box.
    """

    event_id: int
    author: str
    time_ns: int
    run_id: int | None
    objects: tuple[PassObject, ...]
    lost: tuple[LostObject, ...]


@dataclass(frozen=True, eq=False)
class Proposals:
    """Stores the proposals of automatic passes, and reads them with their traces."""

    writer: Writer

    def replace(
        self,
        frame_id: int,
        proposals: Sequence[Proposal],
        context: WriteContext,
        *,
        lost: Sequence[LostObject] = (),
        run: RunShare | None = None,
        track_ids: Sequence[int | None] | None = None,
        box_kind: BoxKind = BoxKind.BOX,
        others: Sequence[Label] = (),
    ) -> Replaced:
        """Replaces the unreviewed labels of a frame with new proposals.

        Accepted, edited and rejected labels stay. A proposal is covered if its exact 3D IoU with one of them, of the
        same class, is 0.5 or more: it gets no label, and the log stores it with the uid of the covering label.

        Args:
            context: its source is normally AUTO, so that a pass over a finalised frame is rejected.
            run: if given, the frame is recorded as done for that run, in the same transaction.
            track_ids: of the proposals' objects over the recording, if the pass followed them from another frame; an
                id that a reviewed label of this frame uses is ignored.
            box_kind: what the proposed boxes enclose: what the view detector measures.
            others: labels of the other cameras of a rig, in this frame's camera; they cover proposals, too.

        Raises:
            StaleRevisionError, FinalisedFrameError, ProjectError: as `Writer.to_frame`.
        """
        with self.writer.store.write() as connection:
            # the cheap checks come before the IoU
            where = require_writable(connection, frame_id, context)
            if run is not None:
                read_run(connection, run.run_id)
            reviewed = [label for label in read_labels(connection, frame_id) if label.state is not ReviewState.PROPOSED]
            covering = covered_by(proposals, [*reviewed, *others])
            # two boxes of a frame never share a track: the reviewed label keeps it
            taken = {label.track_id for label in reviewed if label.state is not ReviewState.REJECTED}
            ids = [None if id in taken else id for id in track_ids or [None] * len(proposals)]
            with storable(f"{where}: a proposal"):
                objects = tuple(
                    ProposedObject(
                        uid=uuid.uuid4().hex, proposal=ProposalRecord.of(each), covered_by=cover, track_id=id
                    )
                    for each, cover, id in zip(proposals, covering, ids, strict=True)
                )
                payload = ProposalsReplaced(
                    run=run.run_id if run else None, objects=objects, lost=tuple(lost), box_kind=box_kind
                )
            receipt = self.writer.to_frame_in(connection, frame_id, (payload,), context)
            if run is not None:
                time_ns = self.writer.store.clock()
                record_result(connection, run.run_id, frame_id, run.seconds, time_ns=time_ns, proposals=len(proposals))
        uids = tuple(entry.uid if entry.covered_by is None else None for entry in objects)
        return Replaced(uids, uids.count(None), receipt)

    def boxes(self, recording_id: int) -> dict[str, OrientedBox]:
        """Label uid -> box as first proposed, of a recording's open proposals; their traces are not parsed."""
        is_open = (frames.c.recording_id == recording_id) & (labels.c.state == ReviewState.PROPOSED.value)
        event_ids = select(labels.c.proposal_event_id).join(frames, frames.c.id == labels.c.frame_id).where(is_open)
        query = select(events.c.id, events.c.frame_id, events.c.payload).where(events.c.id.in_(event_ids))
        boxes: dict[str, OrientedBox] = {}
        with self.writer.store.read() as connection:
            moves = Moves(connection)
            for row in connection.execute(query):
                T = moves.since(row.frame_id, row.id)
                for uid, box in parsed(_proposed, row.payload).items():
                    boxes[uid] = box if T is None else box.transformed(T)
        return boxes

    def latest(self, frame_id: int) -> Pass | None:
        """The latest automatic pass over a frame, or None; its boxes have moved with the cloud, its traces have not."""
        query = (
            select(events)
            .where(events.c.frame_id == frame_id, events.c.kind == "proposals_replaced")
            .order_by(events.c.revision.desc())
            .limit(1)
        )
        with self.writer.store.read() as connection:
            row = connection.execute(query).first()
            return None if row is None else _pass(event_of(row), Moves(connection).since(frame_id, row.id))


@runtime_checkable
class Boxed(Protocol):
    """A class name with a 3D box, such as a `Proposal` or a `Label`."""

    @property
    def label(self) -> str:
        """Class name."""

    @property
    def box(self) -> OrientedBox:
        """Camera frame."""


def covered_by(proposals: Sequence[Boxed], reviewed: Iterable[Label]) -> list[str | None]:
    """For each proposal, the uid of the reviewed label of its class with the greatest 3D IoU, if 0.5 or more."""
    covering: list[str | None] = [None] * len(proposals)
    labels = list(reviewed)
    for name in {label.label for label in labels}:
        indices = [index for index, proposal in enumerate(proposals) if proposal.label == name]
        candidates = [label for label in labels if label.label == name]
        if not indices:
            continue
        iou = iou_3d_matrix([proposals[index].box for index in indices], [label.box for label in candidates])
        for index, row in zip(indices, iou, strict=True):
            best = int(np.argmax(row))
            if row[best] >= SAME_OBJECT_IOU:
                covering[index] = candidates[best].uid
    return covering


def _payload(event: Event) -> ProposalsReplaced:
    if not isinstance(event.payload, ProposalsReplaced):
        raise ProjectError(f"event {event.id} should hold proposals, not {event.payload.kind}; {RESTORE}")
    return event.payload


def _pass(event: Event, T: RigidTransform | None) -> Pass:
    payload = _payload(event)
    proposals = [entry.proposal.proposal() for entry in payload.objects]
    if T is not None:
        proposals = [replace(each, box=each.box.transformed(T)) for each in proposals]
    objects = tuple(
        PassObject(entry.uid, entry.covered_by, each) for entry, each in zip(payload.objects, proposals, strict=True)
    )
    return Pass(event.id, event.author, event.time_ns, payload.run, objects, payload.lost)


def _proposed(content: str) -> dict[str, OrientedBox]:
    """The proposed boxes in an event's payload, by label uid."""
    payload = json.loads(content)
    entries = payload.get("objects", [payload])
    return {entry["uid"]: BoxRecord.model_validate(entry["proposal"]["box"]).box() for entry in entries}
