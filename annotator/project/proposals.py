"""What automatic passes proposed: new proposals in place of old ones, next to what has been reviewed."""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from sqlalchemy import select

from annotator.geometry.iou import iou_3d_matrix
from annotator.project.events import Event, event_of
from annotator.project.jobs import read_run, record_result
from annotator.project.labels import read_labels
from annotator.project.payloads import LabelProposed, ProposalsReplaced, ProposedObject
from annotator.project.records import BoxRecord, ProposalRecord, storable
from annotator.project.schema import events, frames, labels
from annotator.project.writing import Change, Receipt, Writer, require_writable
from annotator.types import Label, LostObject, OrientedBox, Proposal, ReviewState
from annotator.types.errors import NotFoundError, ProjectError

SAME_OBJECT_IOU = 0.5


@dataclass(frozen=True)
class RunShare:
    """The part of a batch run that one frame was: the run's id, and the seconds that the frame took."""

    run_id: int
    seconds: float


@dataclass(frozen=True)
class Replaced:
    """What an automatic pass changed.

    Attributes:
        uids: of the new labels, in the proposals' order, None for each that a reviewed label covers.
        covered: how many those are.
        receipt: as of every write.
    """

    uids: tuple[str | None, ...]
    covered: int
    receipt: Receipt


@dataclass(frozen=True, eq=False)
class PassObject:
    """One proposal of a pass.

    Attributes:
        uid: of the label that it became.
        covered_by: uid of the reviewed label that said the same already, so that no label was made; else None.
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
        run_id: the batch run, where it was one.
        objects: all that it proposed.
        lost: frustums that led to no box.
    """

    event_id: int
    author: str
    time_ns: int
    run_id: int | None
    objects: tuple[PassObject, ...]
    lost: tuple[LostObject, ...]


@dataclass(frozen=True, eq=False)
class Proposals:
    """Takes in the proposals of automatic passes, and reads their traces back."""

    writer: Writer

    def replace(
        self,
        frame_id: int,
        proposals: Sequence[Proposal],
        change: Change,
        *,
        lost: Sequence[LostObject] = (),
        run: RunShare | None = None,
        track_ids: Sequence[int | None] | None = None,
    ) -> Replaced:
        """Put new proposals in place of those that nobody has reviewed.

        Accepted, edited and rejected labels stay. A proposal whose exact 3D IoU with one of them, of the same class,
        is 0.5 or more says nothing new and becomes no label; the log keeps it with the uid of that label.

        Args:
            change: its source is normally AUTO, which a finalised frame refuses.
            run: where given, the frame is noted as done for that run, in the same transaction.
            track_ids: of the proposals' objects over the recording, where the pass followed them from another frame;
                one that a reviewed label of this frame has is passed over.

        Raises:
            StaleRevisionError, FinalisedFrameError, ProjectError: as `Writer.to_frame`.
        """
        with self.writer.store.write() as connection:
            # the cheap refusals before the geometry
            where = require_writable(connection, frame_id, change)
            if run is not None:
                read_run(connection, run.run_id)
            reviewed = [label for label in read_labels(connection, frame_id) if label.state is not ReviewState.PROPOSED]
            covering = covered_by(proposals, reviewed)
            # two boxes of a frame are two objects, and somebody has said which of them this one is
            taken = {label.track_id for label in reviewed if label.state is not ReviewState.REJECTED}
            ids = [None if id in taken else id for id in track_ids or [None] * len(proposals)]
            with storable(f"{where}: a proposal"):
                objects = tuple(
                    ProposedObject(
                        uid=uuid.uuid4().hex, proposal=ProposalRecord.of(each), covered_by=cover, track_id=id
                    )
                    for each, cover, id in zip(proposals, covering, ids, strict=True)
                )
                payload = ProposalsReplaced(run=run.run_id if run else None, objects=objects, lost=tuple(lost))
            receipt = self.writer.to_frame_in(connection, frame_id, (payload,), change)
            if run is not None:
                time_ns = self.writer.store.clock()
                record_result(connection, run.run_id, frame_id, run.seconds, time_ns=time_ns, proposals=len(proposals))
        uids = tuple(entry.uid if entry.covered_by is None else None for entry in objects)
        return Replaced(uids, uids.count(None), receipt)

    def of_label(self, uid: str) -> Proposal | None:
        """The proposal that a label came from, as it was before any edit; None for a label that was not proposed.

        Raises:
            NotFoundError: no such label.
        """
        query = (
            select(labels.c.proposal_event_id, events)
            .outerjoin(events, events.c.id == labels.c.proposal_event_id)
            .where(labels.c.uid == uid)
        )
        with self.writer.store.read() as connection:
            row = connection.execute(query).first()
        if row is None:
            raise NotFoundError(f"the project has no label {uid} (any more)")
        if row.proposal_event_id is None:
            return None
        event = event_of(row)
        if isinstance(event.payload, LabelProposed) and event.payload.proposal is not None:
            return event.payload.proposal.proposal()
        return next(entry.proposal.proposal() for entry in _payload(event).objects if entry.uid == uid)

    def boxes(self, recording_id: int) -> dict[str, OrientedBox]:
        """The boxes of a recording's open proposals as they were proposed, by uid; no other part of a trace is read."""
        open_ones = (frames.c.recording_id == recording_id) & (labels.c.state == ReviewState.PROPOSED.value)
        own = select(labels.c.proposal_event_id).join(frames, frames.c.id == labels.c.frame_id).where(open_ones)
        found: dict[str, OrientedBox] = {}
        with self.writer.store.read() as connection:
            for (content,) in connection.execute(select(events.c.payload).where(events.c.id.in_(own))):
                payload = json.loads(content)
                for entry in payload.get("objects", [payload]):
                    found[entry["uid"]] = BoxRecord.model_validate(entry["proposal"]["box"]).box()
        return found

    def latest(self, frame_id: int) -> Pass | None:
        """The latest automatic pass over a frame, or None."""
        query = (
            select(events)
            .where(events.c.frame_id == frame_id, events.c.kind == "proposals_replaced")
            .order_by(events.c.revision.desc())
            .limit(1)
        )
        with self.writer.store.read() as connection:
            row = connection.execute(query).first()
        return None if row is None else _pass(event_of(row))


@runtime_checkable
class Boxed(Protocol):
    """What has a class and a 3D box, such as a `Proposal` or a `Label`."""

    @property
    def label(self) -> str:
        """Class name."""

    @property
    def box(self) -> OrientedBox:
        """Camera frame."""


def covered_by(proposals: Sequence[Boxed], reviewed: Iterable[Label]) -> list[str | None]:
    """For each proposal the uid of the reviewed label of its class that overlaps it most, if by 0.5 or more."""
    found: list[str | None] = [None] * len(proposals)
    known = list(reviewed)
    for name in {label.label for label in known}:
        mine = [index for index, proposal in enumerate(proposals) if proposal.label == name]
        theirs = [label for label in known if label.label == name]
        if not mine:
            continue
        iou = iou_3d_matrix([proposals[index].box for index in mine], [label.box for label in theirs])
        for index, row in zip(mine, iou, strict=True):
            best = int(np.argmax(row))
            if row[best] >= SAME_OBJECT_IOU:
                found[index] = theirs[best].uid
    return found


def _payload(event: Event) -> ProposalsReplaced:
    if not isinstance(event.payload, ProposalsReplaced):
        raise ProjectError(f"event {event.id} should hold proposals, but is {event.payload.kind}; rebuild the project")
    return event.payload


def _pass(event: Event) -> Pass:
    payload = _payload(event)
    objects = tuple(PassObject(entry.uid, entry.covered_by, entry.proposal.proposal()) for entry in payload.objects)
    return Pass(event.id, event.author, event.time_ns, payload.run, objects, payload.lost)
