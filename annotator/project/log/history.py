"""Undo and redo of each operator's own actions, over all frames, from the event log.

The log is append-only: an undo appends events that restore the state before an action, and is an action itself. So a
redo is the undo of an undo. The order of an operator's actions determines both stacks: a new action empties the redo
stack. Automatic passes, and imports by programs, are not actions and cannot be undone.

An action may change several recordings. While one of them is removed from the project, undo and redo revert the part in
the others. The part in the removed one keeps its place in its stack, and is offered when the recording is back. So the
parts of such an action are undone, and redone, one after the other from then on.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

from sqlalchemy import Connection, bindparam, func, select, true

from annotator.project.adjusting import adjustment_of
from annotator.project.classes.applying import made_changes
from annotator.project.config import ProjectConfig, read_config
from annotator.project.database.schema import AnyRow, events, frames, recordings, revertible
from annotator.project.log.event_types import LabelState, Payload
from annotator.project.log.events import Effort
from annotator.project.log.records import parsed, said_of
from annotator.project.log.undo_state import (
    FRAME,
    IMAGE,
    LABEL,
    RECORDING,
    SOURCE,
    VALUES,
    VIEW,
    AllowedValues,
    Since,
    present_state,
    read_state,
    restoring,
    same_state,
)
from annotator.project.log.writing import FramePart, Receipt, WriteContext, Writer
from annotator.project.recordings import removed_recordings
from annotator.project.sources import said_again
from annotator.types import Source
from annotator.types.errors import HistoryError, TrackTakenError

# Events of automatic passes and imports that may change a target after an action.
PASSES = (
    "proposals_replaced",
    "proposals_imported",
    "tracks_linked",
    "image_boxes_set",
    "view_boxes_set",
    "label_edited",
)

# Event kind -> verb for the page; the first kind that occurs in an action names the action.
VERBS = (
    ("label_proposed", "propose"),
    ("label_created", "draw"),
    ("label_deleted", "delete"),
    ("label_rejected", "reject"),
    ("label_edited", "edit"),
    ("label_accepted", "accept"),
    ("label_tracked", "track"),
    ("label_attributes_set", "set attributes of"),
    ("frame_attributes_set", "set attributes of the frame"),
    ("frame_finalised", "finalise"),
    ("frame_reopened", "reopen"),
    ("view_boxes_set", "draw on a view"),
    ("image_boxes_set", "draw on the image"),
)


# Built once: a save runs both, and building them takes longer than running them.
_ACTIONS = (
    select(events.c.id, events.c.action, events.c.undoes, frames.c.recording_id)
    .join(frames, frames.c.id == events.c.frame_id)
    .where(events.c.author == bindparam("author"), events.c.action.is_not(None), events.c.id > bindparam("last"))
    .order_by(events.c.id)
)
_NEWEST = select(func.coalesce(func.max(events.c.id), 0))
_CHANGES = (
    select(
        events.c.id,
        events.c.frame_id,
        events.c.kind,
        events.c.source,
        frames.c.recording_id,
        frames.c.key,
        revertible.c.subject.label("target"),
        revertible.c.before,
        revertible.c.after,
    )
    .join(revertible, revertible.c.event_id == events.c.id)
    .join(frames, frames.c.id == events.c.frame_id)
    .where(events.c.action == bindparam("action"))
    .order_by(events.c.id)
)


@dataclass(frozen=True)
class Step:
    """One entry of a stack.

    Attributes:
        action: the action to revert: the original one, or its latest undo or redo.
        original: the operator's original action.
        recordings: ids of the recordings in which it is to be reverted.
    """

    action: str
    original: str
    recordings: frozenset[int]


@dataclass(frozen=True)
class Reverted:
    """The result of an undo or redo.

    Attributes:
        frame_id: the frame; for several frames, the first one of the action.
        receipt: of that frame.
        words: description of the action, such as "accept person (frame 000012)", and the attributes of which values
            could not be restored, because the project no longer allows these.
        original: the operator's original action.
        others: the other changed frames, each with its receipt.
    """

    frame_id: int
    receipt: Receipt
    words: str
    original: str
    others: tuple[tuple[int, Receipt], ...] = ()


@dataclass
class _Stacks:
    """An operator's stacks after the event `last`.

    Attributes:
        known: the recordings of all actions so far.
        words: descriptions, by original action and then by the recordings in which it would be reverted.
        lock: held by the thread that uses them.
    """

    last: int = 0
    known: dict[str, set[int]] = field(default_factory=dict)
    undo: list[Step] = field(default_factory=list)
    redo: list[Step] = field(default_factory=list)
    words: dict[str, dict[frozenset[int], str]] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def follow(self, connection: Connection, author: str) -> None:
        """Reads the operator's events since `last`."""
        for row in connection.execute(_ACTIONS, {"author": author, "last": self.last}):
            self.last = row.id
            # an action that is written in several calls has its place since the first
            self.words.pop(row.action, None)
            if row.recording_id not in self.known.get(row.action, ()):
                self.add(row.action, row.undoes, row.recording_id)

    def description(self, connection: Connection, step: Step) -> str:
        """What a step has done, in words."""
        known = self.words.setdefault(step.original, {})
        if step.recordings not in known:
            known[step.recordings] = _description(connection, step)
        return known[step.recordings]

    def add(self, action: str, undoes: str | None, recording: int) -> None:
        """Updates both stacks with what the operator's latest action has changed in one more recording."""
        is_new = action not in self.known
        self.known.setdefault(action, set()).add(recording)
        if undoes is None:
            if is_new:
                self.redo.clear()
            _put(self.undo, Step(action, action, frozenset({recording})), is_new)
            return
        for source, target in ((self.undo, self.redo), (self.redo, self.undo)):
            index = _place(source, undoes)
            if index is not None:
                _put(target, Step(action, source[index].original, frozenset({recording})), is_new)
                # the entries above were skipped: in this recording because others have changed their targets, in
                # others perhaps because these are removed
                above = (replace(step, recordings=step.recordings - {recording}) for step in source[index:])
                source[index:] = [step for step in above if step.recordings]
                return


def _place(steps: Sequence[Step], action: str) -> int | None:
    """The index of an action in a stack."""
    return next((n for n in reversed(range(len(steps))) if steps[n].action == action), None)


def _put(steps: list[Step], step: Step, is_new: bool) -> None:
    """Adds a step on top, or, unless it is new, its recordings to the step of the same action."""
    index = None if is_new else _place(steps, step.action)
    if index is None:
        steps.append(step)
    else:
        steps[index] = replace(step, recordings=steps[index].recordings | step.recordings)


class History:
    """Undoes and redoes actions. Thread-safe."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._stacks_by_author: dict[str, _Stacks] = {}

    def next(self, author: str) -> tuple[str | None, str | None]:
        """Descriptions of the operator's next undo and redo; None where the stack is empty."""
        with self._writer.store.read() as connection, self._stacks(connection, author) as stacks:
            removed = removed_recordings(connection)
            undo, redo = (next(_without(steps, removed), None) for steps in (stacks.undo, stacks.redo))
            return (
                None if undo is None else stacks.description(connection, undo),
                None if redo is None else stacks.description(connection, redo),
            )

    def undo(self, author: str, *, skip: bool = False, effort: Effort | None = None) -> Reverted:
        """Reverts the operator's last action.

        Args:
            skip: skip actions whose targets another author has changed since, or whose classes were removed.

        Raises:
            HistoryError: the stack is empty, another author has changed the target since, or its class is gone.
        """
        return self._revert(author, is_undo=True, skip=skip, effort=effort)

    def redo(self, author: str, *, skip: bool = False, effort: Effort | None = None) -> Reverted:
        """Repeats the action that was undone last; arguments and errors as in `undo`."""
        return self._revert(author, is_undo=False, skip=skip, effort=effort)

    def _revert(self, author: str, *, is_undo: bool, skip: bool, effort: Effort | None) -> Reverted:
        with self._writer.store.write() as connection:
            with self._stacks(connection, author) as stacks:
                kept = stacks.undo if is_undo else stacks.redo
                steps = list(_without(kept, removed_recordings(connection)))
            if not steps:
                raise HistoryError(f"{author} has nothing to {'undo' if is_undo else 'redo'}")
            config, some_left = read_config(self._writer.folder), False
            for step in steps:
                rows = _changes_of(connection, step.action, step.recordings)
                since, allowed = Since(connection), AllowedValues(config.attributes)
                payloads_by_frame = _restoring_by_frame(connection, rows, since, config, allowed)
                left_out = sorted(allowed.left_out)
                if not payloads_by_frame:
                    continue
                conflict = _removed_class(payloads_by_frame, config) or _conflict(connection, rows, since, allowed)
                if conflict is None:
                    try:
                        with connection.begin_nested():
                            receipts = self._restore(connection, payloads_by_frame, author, step, effort)
                        break
                    except TrackTakenError as error:
                        conflict = f"{error}"
                some_left = True
                if not skip:
                    raise HistoryError(
                        f"{_description(connection, step)}: cannot be {'undone' if is_undo else 'redone'} because "
                        f"{conflict}; nothing was changed; both versions are in the log",
                        frame_id=rows[0].frame_id,
                    )
            else:
                why = ": others have changed the same data, or its class was removed" if some_left else ""
                raise HistoryError(
                    f"{author} has nothing {'left ' if some_left else ''}to {'undo' if is_undo else 'redo'}{why}"
                )
            (first, receipt), *others = zip(payloads_by_frame, receipts, strict=True)
            words = _description(connection, step)
            if left_out:
                words += f"; without values that the project no longer allows: {', '.join(left_out)}"
            return Reverted(first, receipt, words, step.original, tuple(others))

    def _restore(
        self,
        connection: Connection,
        payloads_by_frame: dict[int, list[Payload]],
        author: str,
        step: Step,
        effort: Effort | None,
    ) -> tuple[Receipt, ...]:
        parts = []
        for frame_id, payloads in payloads_by_frame.items():
            revision = connection.execute(select(frames.c.revision).where(frames.c.id == frame_id)).scalar_one()
            context = WriteContext(revision, author, effort=effort, undoes=step.action)
            parts.append(FramePart(frame_id, payloads, context))
            # counted once, on the first frame
            effort = None
        return self._writer.to_frames_in(connection, parts)

    @contextmanager
    def _stacks(self, connection: Connection, author: str) -> Iterator[_Stacks]:
        """The operator's stacks as of the transaction, which no other thread uses within the block.

        Only events since the last call are read: the history of an operator can be long, and every save names its
        newest steps. A snapshot can be older than the kept stacks, as another page of the operator has saved since it
        began. It then gets stacks of its own: the kept ones have steps whose events it does not see.
        """
        kept = self._stacks_by_author.setdefault(author, _Stacks())
        with kept.lock:
            stacks = kept if kept.last <= connection.execute(_NEWEST).scalar_one() else _Stacks()
            stacks.follow(connection, author)
            yield stacks


def _without(steps: Sequence[Step], removed: Collection[int]) -> Iterator[Step]:
    """Yields the steps of a stack without some recordings, newest first."""
    for step in reversed(steps):
        if left := step.recordings.difference(removed):
            yield step if len(left) == len(step.recordings) else replace(step, recordings=left)


def _changes_of(connection: Connection, action: str, recordings: Collection[int]) -> list[AnyRow]:
    """What an action has changed in some recordings."""
    changed = connection.execute(_CHANGES, {"action": action}).all()
    return [row for row in changed if row.recording_id in recordings]


def _restoring_by_frame(
    connection: Connection, rows: Sequence[AnyRow], since: Since, config: ProjectConfig, allowed: AllowedValues
) -> dict[int, list[Payload]]:
    """The events that revert an action, by frame in its order; frames with nothing to restore are omitted."""
    by_frame: dict[int, list[AnyRow]] = {}
    for row in rows:
        by_frame.setdefault(row.frame_id, []).append(row)
    payloads = {id: _restoring(connection, part, since, config, allowed) for id, part in by_frame.items()}
    return {frame_id: part for frame_id, part in payloads.items() if part}


def _removed_class(payloads_by_frame: dict[int, list[Payload]], config: ProjectConfig) -> str | None:
    """Says which class would be needed that the project no longer has, if any."""
    used = {name for payloads in payloads_by_frame.values() for payload in payloads for name in payload.classes()}
    gone = sorted(used - set(config.classes))
    return f"the class {gone[0]!r} was removed" if gone else None


def _conflict(connection: Connection, rows: Sequence[AnyRow], since: Since, allowed: AllowedValues) -> str | None:
    """Describes a target that has changed since the action, and by whom; None if all are unchanged."""
    last_rows = {(row.frame_id, row.target): row for row in rows}
    for row in last_rows.values():
        present = read_state(connection, row.frame_id, row.target)
        after = present_state(since, row.frame_id, row.target, row.after, row.id)
        present, after = (allowed.state(row.target, state) for state in (present, after))
        if not same_state(row.target, present, after):
            author, when = _last_change(connection, row)
            return f"{_target_name(row.target, row.after or row.before)} was changed by {author} since{when}"
    return None


def _last_change(connection: Connection, row: AnyRow) -> tuple[str, str]:
    """Author and time of the last change of a row's target after that row."""
    of_frame = not row.target.startswith(RECORDING)
    of_target = (
        select(events.c.author, events.c.time_ns)
        .join(revertible, revertible.c.event_id == events.c.id)
        .where(revertible.c.subject == row.target, events.c.id > row.id)
        .where(events.c.frame_id == row.frame_id if of_frame else true())
        .order_by(events.c.id.desc())
        .limit(1)
    )
    change = connection.execute(of_target).first()
    if change is None:
        # automatic passes and imports have many targets and no rows in `revertible`
        kinds = events.c.kind.in_(PASSES)
        of_passes = select(events.c.author, events.c.time_ns).where(
            events.c.frame_id == row.frame_id, events.c.id > row.id, events.c.action.is_(None), kinds
        )
        change = connection.execute(of_passes.order_by(events.c.id.desc()).limit(1)).first()
    found = change or next(iter(made_changes(connection, row.id)[-1:]), None)
    if found is None:
        return "another author", ""
    moment = datetime.fromtimestamp(found.time_ns / 1e9, UTC)
    return found.author, f" ({moment:%Y-%m-%d %H:%M:%S} UTC)"


def _restoring(
    connection: Connection, rows: Sequence[AnyRow], since: Since, config: ProjectConfig, allowed: AllowedValues
) -> list[Payload]:
    """The events that restore each target of an action to its state before the action, the last target first.

    Targets that the action itself has restored, such as a label that it created and deleted, need no event.
    """
    last = {row.target: row for row in rows}
    first = {row.target: row for row in reversed(rows)}
    payloads: list[Payload] = []
    for target, row in first.items():
        if row.before == last[target].after and (row.before is None or target == FRAME):
            continue
        state = allowed.state(target, present_state(since, row.frame_id, target, row.before, row.id))
        kind, _, name = target.partition(":")
        is_said = kind == SOURCE
        payloads.append(
            said_again(connection, row.frame_id, name, said_of(state), config) if is_said else restoring(target, state)
        )
    return payloads


# --- descriptions for the page ----------------------------------------------------------------------------------------


def _description(connection: Connection, step: Step) -> str:
    return _action_words(connection, _changes_of(connection, step.original, step.recordings))


def _target_name(target: str, state: str | None) -> str:
    """Name of a target, such as "the person label"; `state` as returned by `read_state`."""
    kind = target.partition(":")[0]
    if kind == LABEL and state is not None:
        return f"the {parsed(LabelState.model_validate_json, state).label} label"
    return {
        LABEL: "the label",
        IMAGE: "the boxes on the image",
        VIEW: "the box on the view",
        FRAME: "the frame",
        VALUES: "the attributes of the frame",
        RECORDING: "the recording",
        SOURCE: f"what {target.partition(':')[2]} says",
    }[kind]


def _action_words(connection: Connection, rows: Sequence[AnyRow]) -> str:
    """Description of an action, such as "accept person (frame 000012)" or "delete 3 labels (frame 000012)"."""
    where = _frame_range(rows)
    if rows[0].source == Source.IMPORTED.value:
        kind, _, name = rows[0].target.partition(":")
        what = {SOURCE: f"boxes of {name}", LABEL: "3D boxes"}.get(kind, "2D boxes")
        return f"import {what} ({where})"
    if rows[0].target.startswith(RECORDING):
        return _adjustment_words(connection, rows[0])
    kinds = {row.kind for row in rows}
    kind, verb = next(((kind, verb) for kind, verb in VERBS if kind in kinds), ("", "change"))
    # not those that are replaced by new proposals, or given the track of a deleted box
    counted = [row for row in rows if row.target.startswith(LABEL) and kind in ("", row.kind)]
    by_target = {row.target: row for row in counted}
    if len(by_target) > 1:
        return f"{verb} {len(by_target)} labels ({where})"
    for row in by_target.values():
        name = parsed(LabelState.model_validate_json, row.after or row.before).label
        return f"{verb} {name} ({where})"
    return f"{verb} {where}" if kinds & {"frame_finalised", "frame_reopened"} else f"{verb} ({where})"


def _adjustment_words(connection: Connection, row: AnyRow) -> str:
    """Such as "set up of room-3"."""
    named = select(recordings.c.name).where(recordings.c.id == int(row.target.partition(":")[2]))
    before, after = adjustment_of(row.before), adjustment_of(row.after)
    what = "set up of" if before.correction == after.correction else "correct the calibration of"
    return f"{what} {connection.execute(named).scalar_one()}"


def _frame_range(rows: Sequence[AnyRow]) -> str:
    """Such as "frame 000012" or "frames 000012 to 000019"."""
    first, last = rows[0], rows[-1]
    return f"frame {first.key}" if first.frame_id == last.frame_id else f"frames {first.key} to {last.key}"
