"""Proposals of automatic passes: each pass replaces the unreviewed labels and keeps the reviewed ones."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from sqlalchemy import select

from annotator.project.audit.making import make
from annotator.project.audit.writing import Receipt, Write, WriteContext
from annotator.project.changes import NewLabel, ProposalsReplaced
from annotator.project.classes.values import is_open_still
from annotator.project.database.schema import frames, passes
from annotator.project.database.schema import own_labels as labels
from annotator.project.database.store import driver_of
from annotator.project.jobs import read_run, record_result
from annotator.project.labels import read_stored
from annotator.project.log import Writer, require_writable
from annotator.project.records import parsed, storable
from annotator.project.rows import Terms
from annotator.project.sources import KIND, Brought, agreement, covered_by, merged, regroup, show, told
from annotator.types import BoxKind, OrientedBox, Proposal, ReviewState, Source
from annotator.types.label import Edges


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
    """Stores the proposals of automatic passes, and reads them."""

    writer: Writer

    def replace(
        self,
        frame_id: int,
        proposals: Sequence[Proposal],
        context: WriteContext,
        *,
        run: RunShare | None = None,
        track_ids: Sequence[int | None] | None = None,
        box_kind: BoxKind = BoxKind.BOX,
        action: str | None = None,
    ) -> Replaced:
        """Replaces the unreviewed labels of a frame with new proposals.

        Accepted, edited and rejected labels stay, proposals of which a person has set values, and those that were made
        in frames of other cameras of the moment. A proposal is covered if its exact 3D IoU with one of them, of the
        same class, is 0.5 or more: it gets no label.
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
            own = set(before)
            # an open object that stands still is proposed anew after the pass, which looks for it again
            before |= {row["uid"]: row for row in write.sightings() if is_open_still(row, write.terms)}
            stored = [each.label for each in read_stored(connection, frame_id)]
            staying = [label for label in stored if label.uid not in before]
            covering = covered_by(proposals, staying)
            # two boxes of a frame never share a track: the label that stays keeps it, or the first proposal
            taken = {
                label.track_id for label in stored if label.uid not in own and label.state is not ReviewState.REJECTED
            }
            taken |= write.hidden_tracks()
            ids = list[int | None]()
            for id, cover in zip(track_ids or [None] * len(proposals), covering, strict=True):
                ids.append(None if id in taken or cover is not None else id)
                taken.add(ids[-1])
            with storable(f"{where}: a proposal"):
                new = [
                    NewLabel(
                        each.label,
                        each.box,
                        each.score,
                        id,
                        state=ReviewState.PROPOSED,
                        box_kind=box_kind,
                        proposal=each,
                        uid=write.new_uid(),
                    )
                    for each, cover, id in zip(proposals, covering, ids, strict=True)
                    if cover is None
                ]
                make(write, ProposalsReplaced(proposals, new, None if run is None else run.run_id))
                if any(row["source"] == Source.IMPORTED.value for row in before.values()):
                    regroup(write, write.open_proposals())
                    write.event(KIND)
            receipt = write.finish()
            if run is not None:
                record_result(
                    connection, run.run_id, frame_id, run.seconds, time_ns=write.time_ns, proposals=len(proposals)
                )
            shown = {row["uid"] for row in write.labels() if row["behind"] is None}
        made = iter(new)
        uids = tuple(uid if cover is None and (uid := next(made).uid) in shown else None for cover in covering)
        return Replaced(uids, uids.count(None), receipt)

    def bring(
        self,
        source: str,
        boxes: Mapping[int, Sequence[NewLabel]],
        author: str | None = None,
        action: str | None = None,
    ) -> dict[int, Brought]:
        """Makes boxes of one source the proposals of some frames, in place of what the source has said there before.

        A box is not proposed if a label of its class covers it (exact 3D IoU 0.5 or more) that is reviewed, a proposal
        of which a person has set values, or one that another camera of the moment has. Of boxes of several sources,
        and of ours, that overlap as much, one is shown (`sources.merged`).

        Args:
            boxes: by frame id; their states are ignored. A track id of a reviewed label of the frame is not used
                again. All are stored in one transaction, so give a few frames at once.
            author: who brings them; None = the source itself.
            action: id of the action (`new_action`) that undoes them; None = they cannot be undone.

        Returns:
            The results by frame id; finalised frames are left out, and stay as they are.
        """
        store, done, newest = self.writer.store, dict[int, Brought](), dict[int, int]()
        with store.write() as connection:
            terms = Terms(connection)
            places = ", ".join(map(str, map(int, boxes)))
            query = f"SELECT moment_id, id, revision FROM frames WHERE id IN ({places}) AND NOT finalised ORDER BY id"
            left = driver_of(connection).execute(query).fetchall()
            while left:
                # of each moment one camera at a time, since it changes what the others have
                now = {row[0]: row for row in reversed(left)}
                left = [row for row in left if row is not now[row[0]]]
                parts = []
                for moment_id, frame_id, revision in reversed(now.values()):
                    based_on = newest.get(moment_id, revision)
                    context = WriteContext(based_on, author or source, Source.IMPORTED, effort_target=source)
                    where = f"frame with id {frame_id}"
                    write = Write(store, connection, frame_id, where, context, action, terms)
                    with storable(f"a box of {source}"):
                        parts.append((moment_id, frame_id, write, *told(write, source, boxes[frame_id])))
                groups = merged([[said for _, said in found] for *_, found, _ in parts])
                for (moment_id, frame_id, write, found, is_open), places_of in zip(parts, groups, strict=True):
                    objects = show(write, [[found[place] for place in group] for group in places_of])
                    write.event(KIND)
                    done[frame_id] = Brought(is_open, *agreement(write, source, objects))
                    newest[moment_id] = write.finish().revision
        return done

    def boxes(self, recording_id: int) -> dict[str, OrientedBox]:
        """Label uid -> box as first proposed, of a recording's open proposals."""
        is_open = (frames.c.recording_id == recording_id) & (labels.c.state == ReviewState.PROPOSED.value)
        query = select(labels.c.uid, labels.c.frame_id, labels.c.proposed_box)
        query = query.join(frames, frames.c.id == labels.c.frame_id).where(is_open, labels.c.proposed_box.is_not(None))
        with self.writer.store.read() as connection:
            terms = Terms(connection)
            return {row.uid: terms.box(row.proposed_box, row.frame_id) for row in connection.execute(query)}

    def latest(self, frame_id: int) -> tuple[tuple[str, OrientedBox, float], ...] | None:
        """What the latest automatic pass over a frame has found: class, box and score; None without a pass."""
        query = select(passes.c.content).where(passes.c.frame_id == frame_id)
        with self.writer.store.read() as connection:
            content, terms = connection.execute(query).scalar(), Terms(connection)
            if content is None:
                return None

            def read(text: str) -> tuple[tuple[str, OrientedBox, float], ...]:
                return tuple((name, box, score) for name, box, score, _ in _found(text, terms, frame_id))

            return parsed(read, content)

    def found(self, recording_id: int) -> dict[int, tuple[Found, ...]]:
        """What the latest passes have found in a recording's frames that are there, by the frame's id."""
        query = select(passes.c.frame_id, passes.c.content).join(frames, frames.c.id == passes.c.frame_id)
        query = query.where(frames.c.recording_id == recording_id, frames.c.position.is_not(None))
        with self.writer.store.read() as connection:
            terms = Terms(connection)
            rows = connection.execute(query.order_by(frames.c.position)).all()
            return {id: parsed(partial(_found, terms=terms, frame_id=id), content) for id, content in rows}


class Found(NamedTuple):
    """What a pass has found; `edges` as in `Proposal`."""

    label: str
    box: OrientedBox
    score: float
    edges: Edges | None


def _found(text: str, terms: Terms, frame_id: int) -> tuple[Found, ...]:
    # projects of earlier development versions have no edges
    return tuple(
        Found(terms.names[number], terms.box(box, frame_id), score, tuple(edges[0]) if edges and edges[0] else None)
        for number, score, box, *edges in json.loads(text)
    )
