"""Proposals of automatic passes: each pass replaces the unreviewed labels and keeps the reviewed ones."""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from scipy.spatial.transform import RigidTransform
from sqlalchemy import select

from annotator.project.adjusting import moved_box
from annotator.project.audit.making import make
from annotator.project.audit.writing import Receipt, Write, WriteContext
from annotator.project.changes import NewLabel, ProposalsReplaced, ProposedObject
from annotator.project.database.schema import frames, labels, passes
from annotator.project.jobs import read_run, record_result
from annotator.project.labels import read_stored
from annotator.project.log import Writer, require_writable
from annotator.project.records import ProposalRecord, parsed, storable
from annotator.project.rows import Terms
from annotator.project.sources import KIND, Brought, bring, covered_by, regroup
from annotator.types import BoxKind, LostObject, OrientedBox, Proposal, ReviewState, Source


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
    """

    uids: tuple[str | None, ...]
    covered: int
    receipt: Receipt


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
        action: str | None = None,
    ) -> Replaced:
        """Replaces the unreviewed labels of a frame with new proposals.

        Accepted, edited and rejected labels stay, proposals of which a person has set values, and those that were made
        in frames of other cameras of the moment. A proposal is covered if its exact 3D IoU with one of them, of the
        same class, is 0.5 or more: it gets no label, and the log stores it with the uid of the covering label.
        Proposals of other software stay as well. If one of them is surer of the same object, it hides ours
        (`sources.merged`).

        Args:
            context: its source is normally AUTO, so that a pass over a finalised frame is rejected.
            run: if given, the frame is recorded as done for that run, in the same transaction.
            track_ids: of the proposals' objects over the recording, if the pass followed them from another frame; an
                id that a reviewed label of this frame uses is ignored.
            box_kind: what the proposed boxes enclose: what the view detector measures.
            action: id of the action (`new_action`) that undoes the pass; None = it cannot be undone.
        """
        with self.writer.store.write() as connection:
            # the cheap checks come before the IoU
            where = require_writable(connection, frame_id, context)
            if run is not None:
                read_run(connection, run.run_id)
            write = Write(self.writer.store, connection, frame_id, where, context, action)
            before = {row["uid"]: row for row in write.open_proposals()}
            staying = [each.label for each in read_stored(connection, frame_id) if each.label.uid not in before]
            covering = covered_by(proposals, staying)
            # two boxes of a frame never share a track: the label that stays keeps it, or the first proposal
            taken = {label.track_id for label in staying if label.state is not ReviewState.REJECTED}
            taken |= write.hidden_tracks()
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
                )
                make(write, payload)
                if any(row["source"] == Source.IMPORTED.value for row in before.values()):
                    regroup(write, write.open_proposals())
                    write.event(KIND)
            receipt = write.finish()
            if run is not None:
                record_result(
                    connection, run.run_id, frame_id, run.seconds, time_ns=write.time_ns, proposals=len(proposals)
                )
            shown = {row["uid"] for row in write.labels() if row["behind"] is None}
        uids = tuple(entry.uid if entry.uid in shown else None for entry in objects)
        return Replaced(uids, uids.count(None), receipt)

    def bring(
        self,
        source: str,
        boxes: Mapping[int, Sequence[NewLabel]],
        author: str | None = None,
        action: str | None = None,
    ) -> dict[int, Brought]:
        """Makes boxes of other software the proposals of some frames, as `sources.bring`."""
        return bring(self.writer, source, boxes, author, action)

    def boxes(self, recording_id: int) -> dict[str, OrientedBox]:
        """Label uid -> box as first proposed, of a recording's open proposals; their traces are not parsed."""
        is_open = (frames.c.recording_id == recording_id) & (labels.c.state == ReviewState.PROPOSED.value)
        query = select(labels.c.uid, labels.c.frame_id, labels.c.proposed_box)
        query = query.join(frames, frames.c.id == labels.c.frame_id).where(is_open, labels.c.proposed_box.is_not(None))
        with self.writer.store.read() as connection:
            terms = Terms(connection)
            return {row.uid: terms.box(row.proposed_box, row.frame_id) for row in connection.execute(query)}

    def latest(self, frame_id: int) -> ProposalsReplaced | None:
        """The latest automatic pass over a frame, or None; its boxes have moved with the cloud, its traces have not."""
        query = select(passes.c.content).where(passes.c.frame_id == frame_id)
        with self.writer.store.read() as connection:
            content, T = connection.execute(query).scalar(), Terms(connection).T_camera_cloud(frame_id)
        if content is None:
            return None
        stored = parsed(ProposalsReplaced.model_validate_json, content)
        return stored if T is None else stored.model_copy(update={"objects": [_moved(o, T) for o in stored.objects]})


def _moved(item: ProposedObject, T: RigidTransform) -> ProposedObject:
    proposal = item.proposal.model_copy(update={"box": moved_box(item.proposal.box, T)})
    return item.model_copy(update={"proposal": proposal})
