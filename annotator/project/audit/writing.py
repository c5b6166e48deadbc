"""The one door through which audited rows change: the rows and events of one write."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from functools import cached_property

from sqlalchemy import Connection

from annotator.project.audit.events import (
    Effort,
    Event,
    Key,
    RowChange,
    apply_events,
    as_one,
    changed_row,
    insert_event,
    read_row,
)
from annotator.project.classes.values import is_kept
from annotator.project.database.schema import columns_of, packed
from annotator.project.database.store import Store, driver_of
from annotator.project.recordings import place_in_world, require_nothing_still
from annotator.project.records import BoxRecord
from annotator.project.rows import Row, Terms, new_uid, still_of, with_words
from annotator.types import OrientedBox, ReviewState, Source
from annotator.types.errors import HistoryError, NotFoundError, ProjectError, TrackTakenError
from annotator.types.messages import alternatives

# What the label of a still object has of it.
STILL_COLUMNS = {"class_id", "state", "source", "box_kind", "values_set", "author", "time_ns", "box", "attributes"}
STILL_COLUMNS |= {"score", "expected_iou_loss"}
# Frames with boxes of a class, hidden ones included.
_OF_CLASS = (
    "SELECT frame_id FROM labels WHERE class_id = :id OR instr(ifnull(said, '') || ifnull(image_box, ''), :named) "
    "UNION SELECT frame_id FROM shown_stills WHERE class_id = :id "
    "UNION SELECT frame_id FROM image_labels WHERE instr(boxes, :named) "
    "UNION SELECT frame_id FROM view_labels WHERE frame_id IS NOT NULL AND instr(boxes || ifnull(geometry, ''), :named)"
)


@dataclass(frozen=True)
class Receipt:
    """Result of a write.

    Attributes:
        event_ids: of the appended events, in order.
        revision: of the moment (or view) after the write; the next change must be based on it.
    """

    event_ids: tuple[int, ...]
    revision: int


@dataclass(frozen=True)
class WriteContext:
    """Author of a change, and the revision that it is based on.

    Attributes:
        revision: of the frame (or view) that the change is based on.
        author: name of the operator or program; not empty.
        source: manual, automatic or imported.
        effort: of the operator, if counted.
        effort_target: uid of the label, or id of the draft, that the effort was for; default: the changed labels. Of
            a change of the classes or of a recording, what changes, in words.
        maker: who has made the boxes, if that is not the author: a program that the author has started.
        undoes: the action that this change reverts.
    """

    revision: int
    author: str
    source: Source = Source.MANUAL
    effort: Effort | None = None
    effort_target: str | None = None
    maker: str | None = None
    undoes: str | None = None

    def __post_init__(self) -> None:
        if not self.author.strip():
            raise ProjectError("a change needs an author; pass a name that is not empty")


class Write:
    """Changes of one frame, or of what belongs to none, within one transaction; `finish` stores them.

    Attributes:
        frame_id: None for a view without a frame, and for the classes.
        where: names it in messages.
        terms: of the transaction.
        found: by an automatic pass, to keep in the place of what the one before has; None = it is no pass.
    """

    def __init__(
        self,
        store: Store,
        connection: Connection,
        frame_id: int | None,
        where: str,
        context: WriteContext,
        action: str | None = None,
        terms: Terms | None = None,
    ) -> None:
        self.connection, self.frame_id, self.where, self.context = connection, frame_id, where, context
        self.terms = Terms(connection) if terms is None else terms
        self.time_ns = store.clock()
        self._action = action
        # the known rows, with what was put in their places
        self._now: dict[tuple[str, Key], Row | None] = {}
        self._knows_all = False
        self._rows: list[RowChange] = []
        self._events: list[tuple[str, str | None, tuple[RowChange, ...]]] = []
        self.found: str | None = None
        self._boxes = dict[OrientedBox, str]()
        # frames whose labels or values a change of the classes has changed
        self._stale = set[int]()

    @cached_property
    def moment_id(self) -> int | None:
        """The moment of the frame."""
        query = "SELECT moment_id FROM frames WHERE id = ?"
        found = driver_of(self.connection).execute(query, (self.frame_id,)).fetchone()
        return None if found is None else int(found[0])

    @cached_property
    def rig_id(self) -> int:
        """The rig of the frame's recording."""
        query = "SELECT rig_id FROM recordings JOIN frames ON recordings.id = recording_id WHERE frames.id = ?"
        return int(driver_of(self.connection).execute(query, (self.frame_id,)).fetchone()[0])

    @property
    def author(self) -> Row:
        """The columns of who changes a row, and when."""
        return {"author": self.context.maker or self.context.author, "time_ns": self.time_ns}

    # --- rows ---------------------------------------------------------------------------------------------------------

    def row(self, table: str, key: Key) -> Row | None:
        """A row as it is now."""
        place = table, key
        if place not in self._now:
            self._now[place] = read_row(self.connection, table, key)
        return self._now[place]

    def put(self, table: str, key: Key, after: Row | None) -> None:
        """Puts a row in the place of the present one; None removes it."""
        before = self.row(table, key)
        # a change of the classes changes what sources say, too
        if table == "labels" and before is not None and after is not None and self.frame_id is not None:
            after = with_words(before, after)
        if (change := changed_row(table, key, before, after)) is not None:
            self._now[table, key] = after
            self._rows.append(change)
            if self.frame_id is None:
                self._stale |= self._frames_of(change, after or before or {})

    def label(self, uid: str) -> Row:
        """The row of a label of the frame's moment; of an object that stands still, as the views show it.

        Raises:
            NotFoundError: there is none.
        """
        row = self.row("labels", uid) if (still := still_of(uid)) is None else self._sighting(uid, still)
        if row is None or row["moment_id"] != self.moment_id:
            raise NotFoundError(
                f"{self.where}: label {uid} is not in this frame; it may have been deleted; reload the frame"
            )
        return row

    def _sighting(self, uid: str, still: str) -> Row | None:
        row, query = self.row("stills", still), "SELECT moment_id FROM sightings WHERE uid = ? AND seen = 1"
        if row is None or (seen := driver_of(self.connection).execute(query, (uid,)).fetchone()) is None:
            return None
        label: Row = dict.fromkeys(columns_of("labels"))
        shared = {name: row[name] for name in label.keys() & row.keys()}
        return label | shared | {"uid": uid, "frame_id": self.frame_id, "moment_id": seen[0], "track_linked": 0}

    def put_label(self, uid: str, after: Row, here: bool = False) -> None:
        """Puts a label as changed. An object that stands still changes in all frames, or gets a row of its own `here`,
        which is the exception there.
        """
        if (still := still_of(uid)) is None:
            self.put("labels", uid, after)
        elif here:
            box = self.terms.box(after["box"], self.frame_id)
            own: Row = {"uid": self.new_uid(), "id": self.terms.next_label_id(), "box": self.box_json(box)}
            self.put("labels", own["uid"], after | own)
        elif row := self.row("stills", still):
            self.put("stills", still, row | {name: after[name] for name in STILL_COLUMNS & row.keys()})

    def know(self, table: str, key: Key, row: Row) -> None:
        """Takes a row that was read within the transaction."""
        self._now.setdefault((table, key), row)

    def labels(self) -> list[Row]:
        """The rows of all labels of the frame's moment, in the order of their creation."""
        if not self._knows_all:
            columns = columns_of("labels")
            query = f"SELECT {', '.join(columns)} FROM labels WHERE moment_id = ? AND (hidden = 0 OR frame_id = ?)"
            found = driver_of(self.connection).execute(query, (self.moment_id, self.frame_id)).fetchall()
            for row in (dict(zip(columns, values, strict=True)) for values in found):
                self.know("labels", row["uid"], row)
            self._knows_all = True
        now = [row for (table, _), row in self._now.items() if table == "labels" and row is not None]
        return sorted((row for row in now if row["moment_id"] == self.moment_id), key=lambda row: int(row["id"]))

    def sightings(self) -> list[Row]:
        """The labels that still objects give the frame's moment, as rows."""
        query = "SELECT uid FROM shown_stills WHERE moment_id = ?"
        found = driver_of(self.connection).execute(query, (self.moment_id,)).fetchall()
        return [self.label(uid) for (uid,) in found]

    def hidden_tracks(self) -> set[int]:
        """Tracks that have a box in the moment, made in another camera whose recording is removed."""
        query = (
            "SELECT track_id FROM labels WHERE moment_id = ? AND hidden = 1 AND frame_id <> ? "
            "AND track_id IS NOT NULL AND state <> 'rejected' AND behind IS NULL"
        )
        found = driver_of(self.connection).execute(query, (self.moment_id, self.frame_id))
        return {int(track_id) for (track_id,) in found}

    def open_proposals(self) -> list[Row]:
        """The rows of proposals made here that passes and imports may replace, with those behind them."""
        rows = {row["uid"]: row for row in self.labels()}

        def is_open(row: Row) -> bool:
            # not in the frame of another camera of the moment
            is_proposed = row["state"] == ReviewState.PROPOSED.value and row["frame_id"] == self.frame_id
            return is_proposed and not is_kept(row, self.terms)

        def shown(row: Row) -> Row:
            uid = row["behind"]
            if uid is None or uid in rows or ("labels", uid) in self._now:
                return rows.get(uid, row)
            # of another camera, whose recording is removed; itself, where a change of the classes has removed that one
            return read_row(self.connection, "labels", uid) or row

        return [row for row in rows.values() if is_open(shown(row))]

    def new_uid(self) -> str:
        """The uid of a label that is not there yet."""
        uid = new_uid()
        self._now["labels", uid] = None
        return uid

    def class_id(self, name: str) -> int:
        """The id of a class of the project."""
        if name not in self.terms.classes:
            raise ProjectError(
                f"{self.where}: {name!r} is not a class of the project; {alternatives(name, self.terms.classes)}; "
                "use one of the project's classes, or add the missing ones to the project first"
            )
        return self.terms.ids[name]

    def box_json(self, box: OrientedBox) -> str:
        """A 3D box, camera frame, as it is stored; made once for the label and for what a pass has found."""
        if box not in self._boxes:
            self._boxes[box] = self.terms.box_json(BoxRecord.of(box), self.frame_id)
        return self._boxes[box]

    # --- events -------------------------------------------------------------------------------------------------------

    def event(self, kind: str, view: str | None = None) -> None:
        """Ends one change: the rows that were put since the one before."""
        self._events.append((kind, view, tuple(as_one(self._rows))))
        self._rows = []

    def finish(self) -> Receipt:
        """Stores the rows and the events.

        Raises:
            TrackTakenError: a track would get a second box in the frame.
            HistoryError: the action is a long one, and was undone meanwhile.
        """
        context, stored = self.context, list[Event]()
        undone = "SELECT 1 FROM events WHERE undoes = ?"
        if self._action is not None and driver_of(self.connection).execute(undone, (self._action,)).fetchone():
            raise HistoryError("it was undone while it was running, so it has ended")
        for revision, (kind, view, rows) in enumerate(self._events, context.revision + 1):
            event = Event(
                id=0,
                frame_id=self.frame_id,
                view_id=view,
                revision=revision,
                kind=kind,
                author=context.author,
                time_ns=self.time_ns,
                source=context.source,
                rows=rows,
                action=self._action,
                undoes=context.undoes,
                effort_target=context.effort_target,
                effort=None if stored else context.effort,
            )
            stored.append(insert_event(self.connection, event))
        if stored:
            self._apply(stored)
        if self.found is not None:
            values = (self.frame_id, stored[0].id, packed(self.found))
            self.connection.exec_driver_sql("INSERT OR REPLACE INTO passes VALUES (?, ?, ?)", values)
        return Receipt(tuple(event.id for event in stored), context.revision + len(stored))

    def _apply(self, stored: list[Event]) -> None:
        try:
            apply_events(self.connection, stored)
        except sqlite3.IntegrityError as error:
            if "track_id" not in str(error) and "one_box_a_track" not in str(error):
                raise
            track_id = self._track_with_two()
            raise TrackTakenError(
                f"{self.where}: track {track_id} has a box in this frame already, and an object has one box in a "
                "frame; give one of them another track, or delete the other box",
                track_id,
            ) from error
        for row in (row for event in stored for row in event.rows if row.table == "estimates"):
            if place_in_world(self.connection, int(row.key)):  # a repair finds the world as it was
                require_nothing_still(self.connection, int(row.key))
        # changes in other frames that are based on the earlier still object are refused
        moved = {row.key for event in stored for row in event.rows if row.table == "stills" and row.is_update}
        see = "moment_id IN (SELECT moment_id FROM sightings WHERE still = ? AND seen = 1)"
        newer = f"UPDATE frames SET revision = revision + 1 WHERE {see} AND moment_id IS NOT ?"
        driver_of(self.connection).executemany(newer, [(still, self.moment_id) for still in moved])
        if self.frame_id is not None:
            newer = "UPDATE frames SET revision = ? WHERE moment_id = ?"
            driver_of(self.connection).execute(newer, (stored[-1].revision, self.moment_id))
        elif self._stale:
            # changes that are based on the earlier classes are refused
            driver = driver_of(self.connection)
            moments = {
                driver.execute("SELECT moment_id FROM frames WHERE id = ?", (id,)).fetchone() for id in self._stale
            }
            driver.executemany("UPDATE frames SET revision = revision + 1 WHERE moment_id = ?", sorted(moments))

    def _frames_of(self, change: RowChange, row: Row) -> set[int]:
        """The frames that a change of the classes makes stale; of a renamed class, those with boxes of it."""
        if change.table == "classes":
            if not (change.is_update and "name" in (change.after or {})):
                return set()
            found = driver_of(self.connection).execute(
                _OF_CLASS, {"id": change.key, "named": f'"label":"{change.key}"'}
            )
            return {frame_id for (frame_id,) in found}
        frame_id = row.get("id" if change.table == "frames" else "frame_id")
        return set() if frame_id is None else {frame_id}

    def _track_with_two(self) -> int:
        """The track with two boxes in the frame, after an attempt to store both."""
        seen = self.hidden_tracks()
        for row in self.labels():
            is_its_box = row["behind"] is None and row["state"] != ReviewState.REJECTED.value
            if row["track_id"] is not None and is_its_box:
                if row["track_id"] in seen:
                    return int(row["track_id"])
                seen.add(row["track_id"])
        raise ProjectError(f"{self.where}: a track has two boxes in this frame")
