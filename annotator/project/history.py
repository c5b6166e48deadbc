"""Undo and redo of each operator's own actions, over all frames, from the event log.

Nothing is ever taken out of the log: an undo appends events that give the subjects of an action their former states,
and is an action itself. So a redo is the undo of an undo. An operator's stacks follow from the order of their actions:
a new one empties the redo stack. Automatic passes and imports are no actions and stay as they are.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

from sqlalchemy import Connection, select

from annotator.project.action_words import named, words_of
from annotator.project.events import Effort
from annotator.project.payloads import Payload
from annotator.project.schema import AnyRow, events, frames, revertible
from annotator.project.subjects import FRAME, read_subject, restoring, same_state
from annotator.project.writing import Change, FramePart, Receipt, Writer
from annotator.types.errors import HistoryError

# Events of automatic passes and imports that may change what an action has left.
PASSES = ("proposals_replaced", "tracks_linked", "image_boxes_set", "view_boxes_set", "label_edited")


@dataclass(frozen=True)
class Step:
    """One entry of a stack.

    Attributes:
        action: that is undone next.
        original: what the operator did, behind any undo and redo.
    """

    action: str
    original: str


@dataclass(frozen=True)
class Done:
    """An undo or redo that was made.

    Attributes:
        frame_id: where; of several frames the one that the action began with.
        receipt: as of every write, of that frame.
        words: what was taken back or done again.
        others: the other frames that were changed, and the receipt of each.
    """

    frame_id: int
    receipt: Receipt
    words: str
    others: tuple[tuple[int, Receipt], ...] = ()


@dataclass
class _Stacks:
    """An operator's stacks, as of one event."""

    last: int = 0
    undo: list[Step] = field(default_factory=list)
    redo: list[Step] = field(default_factory=list)

    def take(self, action: str, undoes: str | None) -> None:
        """Take in the operator's next action."""
        if undoes is None:
            self.undo.append(Step(action, action))
            self.redo.clear()
            return
        for source, target in ((self.undo, self.redo), (self.redo, self.undo)):
            place = next((n for n in reversed(range(len(source))) if source[n].action == undoes), None)
            if place is not None:
                target.append(Step(action, source[place].original))
                # what lay above had been changed by others and was passed over
                del source[place:]
                return


class History:
    """Undoes and redoes; threads share it."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._lock = threading.Lock()
        self._known: dict[str, _Stacks] = {}
        self._words: dict[str, str] = {}

    def next(self, author: str) -> tuple[str | None, str | None]:
        """What undo and redo would do next for an operator, in words; None where there is nothing."""
        with self._writer.store.read() as connection:
            undo, redo = self._stacks(connection, author)
            return (
                self._told(connection, undo[-1]) if undo else None,
                self._told(connection, redo[-1]) if redo else None,
            )

    def undo(self, author: str, *, skip: bool = False, effort: Effort | None = None) -> Done:
        """Take back the operator's last action.

        Args:
            skip: pass over actions whose subjects somebody else has changed since.

        Raises:
            HistoryError: there is none, or somebody else has changed the same since.
        """
        return self._revert(author, is_undo=True, skip=skip, effort=effort)

    def redo(self, author: str, *, skip: bool = False, effort: Effort | None = None) -> Done:
        """Do again what was undone last; as `undo`."""
        return self._revert(author, is_undo=False, skip=skip, effort=effort)

    def _revert(self, author: str, *, is_undo: bool, skip: bool, effort: Effort | None) -> Done:
        with self._writer.store.write() as connection:
            steps = self._stacks(connection, author)[0 if is_undo else 1]
            if not steps:
                raise HistoryError(f"{author} has nothing to {'undo' if is_undo else 'redo'}")
            for step in reversed(steps):
                rows = _changes_of(connection, step.action)
                restored = _restored_by_frame(rows)
                if not restored:
                    continue
                conflict = _conflict(connection, rows)
                if conflict is None:
                    break
                if not skip:
                    raise HistoryError(
                        f"{self._told(connection, step)}: cannot be {'undone' if is_undo else 'redone'}, {conflict}; "
                        "nothing was changed, both versions are in the log",
                        frame_id=rows[0].frame_id,
                    )
            else:
                raise HistoryError(f"all that {author} could {'undo' if is_undo else 'redo'} was changed by others")
            parts = []
            for frame_id, payloads in restored.items():
                revision = connection.execute(select(frames.c.revision).where(frames.c.id == frame_id)).scalar_one()
                parts.append(FramePart(frame_id, payloads, Change(revision, author, effort=effort, undoes=step.action)))
                # what it cost is counted once
                effort = None
            receipts = self._writer.to_frames_in(connection, parts)
            others = tuple(zip(list(restored)[1:], receipts[1:], strict=True))
            return Done(parts[0].frame_id, receipts[0], self._told(connection, step), others)

    def _stacks(self, connection: Connection, author: str) -> tuple[list[Step], list[Step]]:
        """Both stacks, brought up to the transaction's moment by the events since the last look."""
        with self._lock:
            known = self._known.setdefault(author, _Stacks())
            query = (
                select(events.c.id, events.c.action, events.c.undoes)
                .where(events.c.author == author, events.c.action.is_not(None), events.c.id > known.last)
                .order_by(events.c.id)
            )
            before: str | None = None
            for row in connection.execute(query):
                # the events of an action follow each other
                if row.action != before:
                    known.take(row.action, row.undoes)
                before, known.last = row.action, row.id
            return list(known.undo), list(known.redo)

    def _told(self, connection: Connection, step: Step) -> str:
        if step.original not in self._words:
            self._words[step.original] = words_of(connection, _changes_of(connection, step.original))
        return self._words[step.original]


def _changes_of(connection: Connection, action: str) -> list[AnyRow]:
    query = (
        select(
            events.c.id,
            events.c.frame_id,
            events.c.kind,
            revertible.c.subject,
            revertible.c.before,
            revertible.c.after,
        )
        .join(revertible, revertible.c.event_id == events.c.id)
        .where(events.c.action == action)
        .order_by(events.c.id)
    )
    return list(connection.execute(query).all())


def _conflict(connection: Connection, rows: Sequence[AnyRow]) -> str | None:
    """Who has changed one of the subjects since, and what; None where all are as the action left them."""
    left = {(row.frame_id, row.subject): row for row in rows}
    for (_, subject), row in left.items():
        present = read_subject(connection, row.frame_id, subject)
        if not same_state(subject, present, row.after):
            who, when = _last_hand(connection, row, subject)
            return f"{named(subject, row.after or row.before)} was changed by {who} since{when}"
    return None


def _last_hand(connection: Connection, row: AnyRow, subject: str) -> tuple[str, str]:
    later = (
        select(events.c.author, events.c.time_ns)
        .join(revertible, revertible.c.event_id == events.c.id)
        .where(revertible.c.subject == subject, events.c.id > row.id, events.c.frame_id == row.frame_id)
        .order_by(events.c.id.desc())
        .limit(1)
    )
    found = connection.execute(later).first()
    if found is None:
        # automatic passes and imports are about many subjects and are not kept by subject
        kinds = events.c.kind.in_(PASSES)
        others = select(events.c.author, events.c.time_ns).where(
            events.c.frame_id == row.frame_id, events.c.id > row.id, events.c.action.is_(None), kinds
        )
        found = connection.execute(others.order_by(events.c.id.desc()).limit(1)).first()
    if found is None:
        return "somebody else", ""
    moment = datetime.fromtimestamp(found.time_ns / 1e9, UTC)
    return found.author, f" ({moment:%Y-%m-%d %H:%M:%S} UTC)"


def _restored_by_frame(rows: Sequence[AnyRow]) -> dict[int, list[Payload]]:
    """What takes an action back, frame by frame, in its order; no entry for a frame with nothing to restore."""
    own = {frame_id: [row for row in rows if row.frame_id == frame_id] for frame_id in {r.frame_id: 0 for r in rows}}
    found = {frame_id: _restored(part) for frame_id, part in own.items()}
    return {frame_id: payloads for frame_id, payloads in found.items() if payloads}


def _restored(rows: Sequence[AnyRow]) -> list[Payload]:
    """The events that give every subject of an action the state before it, the last one first.

    None for what the action itself has put back, such as a label that it has made and deleted.
    """
    last = {row.subject: row for row in rows}
    first = {row.subject: row for row in reversed(rows)}
    return [
        restoring(subject, row.before)
        for subject, row in first.items()
        if not (row.before == last[subject].after and (row.before is None or subject == FRAME))
    ]
