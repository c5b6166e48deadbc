"""Undo and redo of each author's own actions, over all frames.

An undo puts back the columns that an action has changed, where they are still as it left them, and is an action itself.
So a redo is the undo of an undo. The order of an author's actions determines both stacks: a new action empties the redo
stack. A batch pass is one action of who has started it; a change of the classes is one with the rows that follow it.

An action in recordings that are all removed from the project keeps its place in its stack, and is offered when one of
them is back. Another one is reverted as a whole, with the hidden boxes of removed recordings.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

from sqlalchemy import Connection, bindparam, func, select, true

from annotator.project.adjusting import Adjustment, adjustment_row
from annotator.project.adjustments import ESTIMATED, make_stale
from annotator.project.adjustments import KIND as ADJUSTED
from annotator.project.audit.events import (
    CLASSES,
    Effort,
    Event,
    RowChange,
    as_one,
    event_of,
    hide_removed,
    in_moment_of,
    read_row,
    rows_of,
    without_rows,
)
from annotator.project.audit.writing import Write, WriteContext
from annotator.project.classes.attributes import Attribute, AttributeOf, fitting
from annotator.project.classes.changing import BATCH, FOLLOWED, require_consistent, write_classes
from annotator.project.classes.changing import KIND as CLASSES_CHANGED
from annotator.project.database.schema import events, frames, recordings
from annotator.project.database.store import driver_of
from annotator.project.frames import numbers_of
from annotator.project.log import Writer, new_action, require_writable
from annotator.project.recordings import removed_recordings
from annotator.project.rows import Row, Terms, box_2d_of, said_with, stored_said, values_json, values_of
from annotator.project.sources import KIND as IMPORTED
from annotator.types import Source
from annotator.types.errors import FinalisedFrameError, HistoryError, ProjectError, TrackTakenError
from annotator.types.label import AttributeValue

KIND = "restored"
SCHEMA = ("classes", "attributes")
OBJECTS = ("labels", "stills")

# Event kind -> verb for the page; the first kind that occurs in an action names the action.
VERBS = (
    ("still_made", "make still"),
    ("stills_proposed", "propose"),
    ("still_ended", "make moving"),
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
    ("proposals_replaced", "propose"),
    ("tracks_linked", "link"),
)
CLASSES_RECORDING = 0
"""Stands for the recording of what a change of the classes has changed in all of them; never removed."""


# Built once: a save runs both, and building them takes longer than running them.
_OF_ACTION, _ACTIONS = (
    select(*columns, func.coalesce(frames.c.recording_id, CLASSES_RECORDING).label("recording_id"))
    .outerjoin_from(events, frames, frames.c.id == events.c.frame_id)
    .where(*of)
    .order_by(events.c.id)
    for columns, of in (
        ((events.c.id, events.c.frame_id), [events.c.action == bindparam("action")]),
        (
            (events.c.id, events.c.action, events.c.undoes),
            [events.c.author == bindparam("author"), events.c.action.is_not(None), events.c.id > bindparam("last")],
        ),
    )
)
_IDS = func.json_each(bindparam("ids")).table_valued("value")
_EVENTS = select(events).where(events.c.id.in_(select(_IDS.c.value))).order_by(events.c.id)
_AUTHORS = select(events.c.author).where(events.c.action.is_not(None)).distinct()
_LAST_OF_ACTION = select(func.max(events.c.id)).where(events.c.action == bindparam("action"))
_NEWEST = select(func.coalesce(func.max(events.c.id), 0))
# The words for a pass, an import or a change of the classes need none of their rows.
_NAMED = (
    select(*without_rows((events.c.source != Source.MANUAL.value) | events.c.frame_id.is_(None)), frames.c.key)
    .outerjoin_from(events, frames, frames.c.id == events.c.frame_id)
    .where(events.c.action == bindparam("action"))
    .order_by(events.c.id)
)


@dataclass(frozen=True)
class Step:
    """One entry of a stack.

    Attributes:
        action: the action to revert: the original one, or its latest undo or redo.
        original: the operator's original action.
    """

    action: str
    original: str


@dataclass(frozen=True)
class Reverted:
    """The result of an undo or redo.

    Attributes:
        frame_id: the frame; for several frames, the first one of the action; None for a change of the classes.
        words: description of the action, such as "accept person (frame 13)", and the attributes of which values
            could not be restored, because the project no longer allows these.
        original: the operator's original action.
    """

    frame_id: int | None
    words: str
    original: str


@dataclass
class _Stacks:
    """An operator's stacks after the event `last`.

    Attributes:
        recordings: of all actions so far.
        words: descriptions, by original action.
        lock: held by the thread that uses them.
    """

    last: int = 0
    recordings: dict[str, set[int]] = field(default_factory=dict)
    undo: list[Step] = field(default_factory=list)
    redo: list[Step] = field(default_factory=list)
    words: dict[str, str] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def follow(self, connection: Connection, author: str) -> None:
        """Reads the operator's events since `last`."""
        for row in connection.execute(_ACTIONS, {"author": author, "last": self.last}):
            self.last = row.id
            # an action that is written in several calls has its place since the first
            self.words.pop(row.action, None)
            if row.action not in self.recordings:
                self._add(row.action, row.undoes)
            self.recordings.setdefault(row.action, set()).add(row.recording_id)

    def description(self, connection: Connection, step: Step) -> str:
        """What a step has done, in words."""
        if step.original not in self.words:
            self.words[step.original] = _description(connection, step)
        return self.words[step.original]

    def offered(self, steps: Sequence[Step], removed: Collection[int]) -> Iterator[Step]:
        """Yields the steps of a stack that change more than these recordings, the newest first."""
        return (step for step in reversed(steps) if not self.recordings[step.action] <= set(removed))

    def _add(self, action: str, undoes: str | None) -> None:
        if undoes is None:
            self.redo.clear()
            self.undo.append(Step(action, action))
            return
        for source, target in ((self.undo, self.redo), (self.redo, self.undo)):
            index = next((n for n, step in enumerate(source) if step.action == undoes), None)
            if index is not None:
                target.append(Step(action, source[index].original))
                # those above were skipped: others have changed the same, or their recordings were removed
                changed = self.recordings[undoes]
                source[index:] = [
                    step for step in source[index + 1 :] if changed.isdisjoint(self.recordings[step.action])
                ]
                return


class History:
    """Undoes and redoes actions. Thread-safe."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._stacks_by_author: dict[str, _Stacks] = {}

    def next(self, author: str) -> tuple[str | None, str | None]:
        """Descriptions of the operator's next undo and redo; None where the stack is empty."""
        with self._writer.store.read() as connection, self._stacks(connection, author) as stacks:
            removed = removed_recordings(connection)
            undo, redo = (next(stacks.offered(steps, removed), None) for steps in (stacks.undo, stacks.redo))
            return (
                None if undo is None else stacks.description(connection, undo),
                None if redo is None else stacks.description(connection, redo),
            )

    def last_author(self, *, undone: bool = False) -> str | None:
        """The author of the project's newest action that can be undone, or redone (`undone`); None without any."""
        newest = dict[int, str]()
        with self._writer.store.read() as connection:
            removed = removed_recordings(connection)
            for author in connection.execute(_AUTHORS).scalars().all():
                with self._stacks(connection, author) as stacks:
                    step = next(stacks.offered(stacks.redo if undone else stacks.undo, removed), None)
                if step is not None:
                    of_step = {"action": step.action if undone else step.original}
                    newest[connection.execute(_LAST_OF_ACTION, of_step).scalar_one()] = author
        return newest[max(newest)] if newest else None

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
        name = "undo" if is_undo else "redo"
        with self._writer.store.write() as connection:
            with self._stacks(connection, author) as stacks:
                removed = removed_recordings(connection)
                steps = list(stacks.offered(stacks.undo if is_undo else stacks.redo, removed))
            if not steps:
                raise HistoryError(f"{author} has nothing to {name}")
            some_left = False
            for step in steps:
                parts, away, left_out = dict[int | None, list[int]](), set[int | None](), set[str]()
                for row in connection.execute(_OF_ACTION, {"action": step.action}):
                    parts.setdefault(row.frame_id, []).append(row.id)
                    away |= {row.frame_id} if row.recording_id in removed else set()
                try:
                    with connection.begin_nested():
                        changed = self._restore(connection, parts, author, step, effort, left_out)
                except (HistoryError, TrackTakenError, FinalisedFrameError) as error:
                    some_left = True
                    if not skip:
                        raise HistoryError(
                            f"{_description(connection, step)}: cannot be {'undone' if is_undo else 'redone'} because "
                            f"{error}; nothing was changed; both versions are in the log",
                            frame_id=next((frame_id for frame_id in parts if frame_id not in away | {None}), None),
                            can_skip=True,
                        ) from error
                    continue
                if changed:
                    break
            else:
                why = ": others have changed the same data, or its class was removed" if some_left else ""
                raise HistoryError(f"{author} has nothing {'left ' if some_left else ''}to {name}{why}")
            shown = [frame_id for frame_id in changed if frame_id not in away] or changed
            words = _description(connection, step)
            if left_out:
                words += f"; without values that the project no longer allows: {', '.join(sorted(left_out))}"
            return Reverted(shown[0], words, step.original)

    def _restore(
        self,
        connection: Connection,
        parts: dict[int | None, list[int]],
        author: str,
        step: Step,
        effort: Effort | None,
        left_out: set[str],
    ) -> list[int | None]:
        """Puts the rows of each part back, the last part first, one after the other: a pass may have 100,000.

        Returns:
            The frames that it has changed; None: the classes.

        Raises:
            HistoryError: somebody has changed a row since, or what it needs is gone; says what.
        """
        store, action, changed = self._writer.store, new_action(), list[int | None]()
        terms, driver = Terms(connection), driver_of(connection)
        for frame_id, ids in reversed(parts.items()):
            part = _Part(connection, ids, left_out, terms)
            if not part.rows:
                continue
            part.require_as_left()
            context = WriteContext(0, author, part.source, effort=None if changed else effort, undoes=step.action)
            if frame_id is None:
                self._restore_classes(connection, part, context, action)
                terms = Terms(connection)
            else:
                (revision,) = driver.execute("SELECT revision FROM frames WHERE id = ?", (frame_id,)).fetchone()
                context = replace(context, revision=revision)
                where = require_writable(connection, frame_id, context)
                part.put_back(Write(store, connection, frame_id, where, context, action, terms), part.rows)
            changed.append(frame_id)
            for row in part.rows:
                if row.table == "adjustments" and frame_id is not None:
                    make_stale(connection, int(row.key), frame_id)
                    terms = Terms(connection)
        if removed_recordings(connection):  # labels of removed recordings may be there again
            hide_removed(connection)
        return changed[::-1]

    def _restore_classes(self, connection: Connection, part: _Part, context: WriteContext, action: str) -> None:
        """Puts the classes and attributes back, and then the rows that have followed."""
        store, terms = self._writer.store, Terms(connection)
        before = terms.classes, terms.attributes
        of_classes = [row for row in part.rows if row.table in SCHEMA]
        part.put_back(write_classes(store, connection, context, action), of_classes, CLASSES_CHANGED)
        others = [row for row in part.rows if row.table not in SCHEMA]
        for first in range(0, len(others), BATCH):
            write = write_classes(store, connection, replace(context, effort=None), action)
            part.put_back(write, others[first : first + BATCH], FOLLOWED)
        try:
            require_consistent(connection, *before)
        except ProjectError as error:
            raise HistoryError(f"{error}") from error

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


class _Part:
    """What an action has changed in one frame, or of the classes.

    States are compared and put back without values that the project no longer allows.

    Attributes:
        rows: the changed rows, as one change each.
        source: of the undo; a pass that is undone leaves finalised frames alone, like the pass.
        left_out: gets the names of the attributes of which values were left out.
    """

    def __init__(self, connection: Connection, ids: Sequence[int], left_out: set[str], terms: Terms) -> None:
        self.connection, self.left_out, self._terms = connection, left_out, terms
        made = [event_of(row) for row in connection.execute(_EVENTS, {"ids": json.dumps(ids)})]
        self.source = Source.AUTO if made[0].source is Source.AUTO else Source.MANUAL
        self.rows = as_one(row for event in made for row in event.rows)
        self._last = {(row.table, row.key): event for event in made for row in event.rows}

    def put_back(self, write: Write, rows: Sequence[RowChange], kind: str = KIND) -> None:
        """Puts rows back, with one event."""
        self._terms = write.terms
        for row in rows:
            write.put(row.table, row.key, self._target(row))
        write.event(kind, CLASSES if write.frame_id is None else None)
        write.finish()
        terms = Terms(self.connection) if write.frame_id is None else write.terms
        if gone := sorted(self._classes(rows) - set(terms.classes)):
            raise HistoryError(f"the class {gone[0]!r} was removed")

    def _target(self, change: RowChange) -> Row | None:
        """The row to put back."""
        present = read_row(self.connection, change.table, change.key)
        if change.table == "adjustments" and change.before is None:
            # a recording stays one that was adjusted, with what it was added with
            up = select(recordings.c.up).where(recordings.c.id == change.key)
            return adjustment_row(int(change.key), Adjustment(None)) | {"up": self.connection.execute(up).scalar_one()}
        if change.before is None:
            # rows and events may name a class by its id
            if change.table != "classes" or present is None:
                return None
            return present | {"position": None, "colour": None, "shortcut": None, "still": None}
        before = self._allowed(change, change.before, present)
        return before if present is None else present | before

    def require_as_left(self) -> None:
        """Refuses to put back a row that somebody has changed since."""
        for row in self.rows:
            present = read_row(self.connection, row.table, row.key)
            if present is None or row.after is None:
                is_left = present is row.after
            else:
                allowed = self._allowed(row, row.after, present, note=False)
                seen = self._allowed(row, {name: present[name] for name in row.after}, present, note=False)
                is_left = all(seen[name] == allowed[name] for name in row.after if name != "id")
            if not is_left:
                author, when = self._last_change(row)
                raise HistoryError(f"{self._name(row)} was changed by {author} since{when}")

    def _classes(self, rows: Sequence[RowChange]) -> set[str]:
        """The classes that rows need which were put back."""
        used = set[str]()
        for before in (row.before for row in rows):
            if before is not None and "class_id" in before:
                used.add(self._terms.names[before["class_id"]])
            elif before is not None and "boxes" in before:
                used |= {box.label for box in self._terms.boxes_2d(before["boxes"])}
        return used

    def _allowed(self, change: RowChange, state: Row, present: Row | None, *, note: bool = True) -> Row:
        """A state with such values only as the project allows now."""
        terms, allowed = self._terms, dict(state)
        if change.table == "frames" and "attributes" in state:
            of_frames = [each for each in terms.attributes if each.of is AttributeOf.FRAME]
            values = self._fitting(of_frames, values_of(state["attributes"]), note)
            allowed["attributes"] = values_json(values) if values else None
        if change.table in OBJECTS and "attributes" in state:
            of_label = terms.attributes_of(terms.names[(state if present is None else present | state)["class_id"]])
            allowed["attributes"] = values_json(self._fitting(of_label, values_of(state["attributes"]), note))
        image_box = box_2d_of(state.get("image_box"), terms.key)
        if image_box is not None and image_box.label not in terms.classes:
            allowed["image_box"] = None
        if change.table == "labels" and state.get("said") is not None:
            said = stored_said(state["said"])
            if (label := terms.names[int(said.label)]) not in terms.classes:
                return allowed | {"said": None, "of_source": None}
            of_label = terms.attributes_of(label)
            own, given = (self._fitting(of_label, values, note) for values in (said.attributes, said.given))
            allowed["said"] = said_with(state["said"], own, given)
        return allowed

    def _fitting(
        self, attributes: Sequence[Attribute], values: Mapping[str, AttributeValue], note: bool
    ) -> dict[str, AttributeValue]:
        kept = fitting(attributes, values)
        if note:
            self.left_out |= values.keys() - kept.keys()
        return kept

    def _last_change(self, row: RowChange) -> tuple[str, str]:
        """Author and time of the last change of a row after the action."""
        event = self._last[row.table, row.key]
        query = select(events.c.author, events.c.time_ns, events.c.rows).where(events.c.id > event.id)
        if row.table not in ("adjustments", "stills", "estimates") and event.frame_id is not None:
            query = query.where(in_moment_of(event.frame_id) | events.c.frame_id.is_(None))
        for found in self.connection.execute(query.order_by(events.c.id.desc())):
            if any((each.table, each.key) == (row.table, row.key) for each in rows_of(found.rows)):
                moment = datetime.fromtimestamp(found.time_ns / 1e9, UTC)
                return found.author, f" ({moment:%Y-%m-%d %H:%M:%S} UTC)"
        return "another author", ""

    def _name(self, row: RowChange) -> str:
        if row.table in OBJECTS:
            return f"the {_class_of(self.connection, row, self._last[row.table, row.key])} label"
        if row.table == "classes":
            return f"the class {self._terms.names[int(row.key)]}"
        return f"the attribute {row.key}" if row.table == "attributes" else _TABLE_NAMES[row.table]


_TABLE_NAMES = {
    "image_labels": "the boxes on the image",
    "view_labels": "the box on the view",
    "frames": "the frame",
    "adjustments": "the recording",
    "estimates": "the recording",
}


def _class_of(connection: Connection, row: RowChange, event: Event) -> str:
    """The class of a changed label after an event."""
    states = [row.after, row.before]
    if not any(state is not None and "class_id" in state for state in states):
        of_frame = (
            true()
            if event.frame_id is None or row.table == "stills"
            else in_moment_of(event.frame_id) | events.c.frame_id.is_(None)
        )
        query = select(events.c.rows).where(events.c.id > event.id, of_frame).order_by(events.c.id)
        later = (each for content in connection.execute(query).scalars() for each in rows_of(content))
        states += [each.before for each in later if (each.table, each.key) == (row.table, row.key)]
        states.append(read_row(connection, row.table, row.key))
    number = next(state["class_id"] for state in states if state is not None and "class_id" in state)
    return Terms(connection).names[number]


# --- descriptions for the page ----------------------------------------------------------------------------------------


def _description(connection: Connection, step: Step) -> str:
    """Description of an action, such as "accept person (frame 13)" or "delete 3 labels (frame 13)".

    Frames are numbered from 1, as on the page; one that its recording no longer has is named by its key.
    """
    rows = connection.execute(_NAMED, {"action": step.original}).all()
    made, keys = [event_of(row) for row in rows], [row.key for row in rows]
    first, last = made[0], made[-1]
    if first.view_id == CLASSES or first.kind in (ADJUSTED, ESTIMATED):
        return first.effort_target or "change"
    is_one = first.frame_id == last.frame_id
    known = numbers_of(connection, {each.frame_id for each in (first, last) if each.frame_id is not None})
    start, end = (known.get(each.frame_id or 0, key) for each, key in ((first, keys[0]), (last, keys[-1])))
    where = f"frame {start}" if is_one else f"frames {start} to {end}"
    kinds = {event.kind for event in made}
    if first.source is Source.IMPORTED:
        what = f"boxes of {first.effort_target}" if first.kind == IMPORTED else ""
        what = what or ("3D boxes" if any(kind.startswith("label") for kind in kinds) else "2D boxes")
        return f"import {what} ({where})"
    kind, verb = next(((kind, verb) for kind, verb in VERBS if kind in kinds), ("", "change"))
    if first.source is Source.AUTO:
        return f"{verb} boxes ({where})"
    # not those that are replaced by new proposals, or given the track of a deleted box
    counted = {
        row.key: row
        for event in made
        for row in event.rows
        if row.table in OBJECTS and kind in ("", event.kind) and not row.is_behind
    }
    if kind in ("still_made", "still_ended"):  # the labels go, or come, with the object
        counted = {key: row for key, row in counted.items() if row.table == "stills"}
    if len(counted) > 1:
        return f"{verb} {len(counted)} labels ({where})"
    for row in counted.values():
        return f"{verb} {_class_of(connection, row, last)} ({where})"
    return f"{verb} {where}" if kinds & {"frame_finalised", "frame_reopened"} else f"{verb} ({where})"
