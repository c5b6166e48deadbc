"""Proposals of automatic passes: each pass replaces the unreviewed labels and keeps the reviewed ones."""

from __future__ import annotations

import json
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from scipy.spatial.transform import RigidTransform
from sqlalchemy import select

from annotator.project.adjusting import Moves
from annotator.project.classes.completing import kept_proposals
from annotator.project.config import read_config
from annotator.project.database.schema import events, frames, labels
from annotator.project.jobs import read_run, record_result
from annotator.project.labels import NewLabel, read_labels
from annotator.project.log.event_types import ProposalsReplaced, ProposedObject
from annotator.project.log.events import Event, event_of
from annotator.project.log.records import OWN, BoxRecord, ProposalRecord, SaidRecord, parsed, storable
from annotator.project.log.writing import Receipt, WriteContext, Writer, require_writable
from annotator.project.sources import Brought, SourceTracks, beside_new_pass, bring, covered_by, source_tracks
from annotator.types import BoxKind, Label, LostObject, OrientedBox, Proposal, ReviewState
from annotator.types.errors import RESTORE, ProjectError


@dataclass(frozen=True)
class RunShare:
    """One frame's share of a batch run: the run's id, and the frame's processing time in seconds."""

    run_id: int
    seconds: float


@dataclass(frozen=True)
class Replaced:
    """Result of an automatic pass.

    Attributes:
        uids: of the new labels, in the proposals' order; None for a proposal that a reviewed label covers, or that a
            surer proposal of other software hides.
        covered: number of such proposals.
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

        Accepted, edited and rejected labels stay, and proposals of which a person has set values. A proposal is
        covered if its exact 3D IoU with one of them, of the same class, is 0.5 or more: it gets no label, and the log
        stores it with the uid of the covering label.
        Proposals of other software stay as well. If one of them is surer of the same object, it hides ours
        (`sources.merged`).

        Args:
            context: its source is normally AUTO, so that a pass over a finalised frame is rejected.
            run: if given, the frame is recorded as done for that run, in the same transaction.
            track_ids: of the proposals' objects over the recording, if the pass followed them from another frame; an
                id that a reviewed label of this frame uses is ignored.
            box_kind: what the proposed boxes enclose: what the view detector measures.
            others: labels of the other cameras of a rig, in this frame's camera; they cover proposals, too.
        """
        with self.writer.store.write() as connection:
            # the cheap checks come before the IoU
            where = require_writable(connection, frame_id, context)
            if run is not None:
                read_run(connection, run.run_id)
            config = read_config(self.writer.folder)
            kept = kept_proposals(connection, config.attributes, frame_id)
            staying = [
                label
                for label in read_labels(connection, frame_id)
                if label.state is not ReviewState.PROPOSED or label.uid in kept
            ]
            covering = covered_by(proposals, [*staying, *others])
            # two boxes of a frame never share a track: the label that stays keeps it, or the first proposal
            taken = {label.track_id for label in staying if label.state is not ReviewState.REJECTED}
            ids = list[int | None]()
            for id, cover in zip(track_ids or [None] * len(proposals), covering, strict=True):
                ids.append(None if id in taken or cover is not None else id)
                taken.add(ids[-1])
            with storable(f"{where}: a proposal"):
                objects = tuple(
                    ProposedObject(
                        uid=uuid.uuid4().hex, proposal=ProposalRecord.of(each), covered_by=cover, track_id=id
                    )
                    for each, cover, id in zip(proposals, covering, ids, strict=True)
                )
                payload = ProposalsReplaced(
                    run=run.run_id if run else None,
                    objects=objects,
                    lost=tuple(lost),
                    box_kind=box_kind,
                    kept=tuple(sorted(kept)),
                )
            own = [_own(entry, box_kind) for entry in objects if entry.covered_by is None]
            beside = beside_new_pass(connection, frame_id, own, config.classes, kept)
            payloads = (payload,) if beside is None else (payload, beside)
            receipt = self.writer.to_frame_in(connection, frame_id, payloads, context)
            if run is not None:
                time_ns = self.writer.store.clock()
                record_result(connection, run.run_id, frame_id, run.seconds, time_ns=time_ns, proposals=len(proposals))
        hidden = frozenset[str]() if beside is None else frozenset(beside.hidden)
        uids = tuple(entry.uid if entry.covered_by is None and entry.uid not in hidden else None for entry in objects)
        return Replaced(uids, uids.count(None), receipt)

    def bring(
        self,
        source: str,
        boxes: Mapping[int, Sequence[NewLabel]],
        author: str | None = None,
        action: str | None = None,
    ) -> dict[int, Brought]:
        """Makes boxes of other software the proposals of some frames, as `sources.bring.bring`."""
        return bring(self.writer, source, boxes, author, action)

    def source_tracks(self, recording_id: int, source: str) -> SourceTracks:
        """The track ids of a recording, and those of this source among them."""
        return source_tracks(self.writer, recording_id, source)

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


def _own(entry: ProposedObject, box_kind: BoxKind) -> SaidRecord:
    """What a new proposal says, to be compared with boxes of other software."""
    return SaidRecord(
        uid=entry.uid,
        source=OWN,
        label=entry.proposal.label,
        score=entry.proposal.score,
        box=entry.proposal.box,
        track_id=entry.track_id,
        box_kind=box_kind,
    )


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
