"""The one door through which audited rows change; a write checks revision, finalisation, classes and tracks."""

from __future__ import annotations

import json
import sqlite3
import uuid
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, bindparam, func, select

from annotator.geometry.oriented_box import same_box
from annotator.project.adjusting import moved_box
from annotator.project.changes import (
    FrameAttributesSet,
    FrameFinalised,
    FrameReopened,
    ImageBoxesSet,
    LabelAccepted,
    LabelAttributesSet,
    LabelCreated,
    LabelDeleted,
    LabelEdited,
    LabelMoved,
    LabelProposed,
    LabelRejected,
    LabelTracked,
    LinkedLabel,
    Payload,
    ProposalsReplaced,
    TracksLinked,
    ViewBoxesRemoved,
    ViewBoxesSet,
)
from annotator.project.classes.attributes import Attribute, AttributeOf, fitting
from annotator.project.classes.values import Values, after_edit, checked, is_same, new_values, of_tracks
from annotator.project.config import ProjectConfig, read_config
from annotator.project.database.schema import ALL_LABELS, columns_of, events, frames, packed, recordings
from annotator.project.database.store import Store
from annotator.project.events import (
    Effort,
    Event,
    Key,
    RowChange,
    apply_events,
    as_one,
    changed_row,
    insert_event,
    read_events,
    read_row,
    rebuild,
)
from annotator.project.records import ProposalRecord, SaidRecord, storable, suggestion_json
from annotator.project.rows import Row, Terms, driver_of, number_or_none, values_json, values_of
from annotator.types import ReviewState, Source
from annotator.types.errors import FinalisedFrameError, NotFoundError, ProjectError, StaleRevisionError, TrackTakenError
from annotator.types.label import AttributeValue
from annotator.types.messages import alternatives

# Built once, since building this frequent query takes longer than running it.
_FRAME = (
    select(frames.c.key, frames.c.revision, frames.c.finalised, recordings.c.name, recordings.c.removed_ns)
    .join(recordings, recordings.c.id == frames.c.recording_id)
    .where(frames.c.id == bindparam("frame"))
)


@dataclass(frozen=True)
class Receipt:
    """Result of a write.

    Attributes:
        event_ids: of the appended events, in order.
        revision: of the frame (or view) after the write; the next change must be based on it.
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
        effort_target: uid of the label, or id of the draft, that the effort was for; default: the changed labels.
        undoes: the action that this change reverts.
    """

    revision: int
    author: str
    source: Source = Source.MANUAL
    effort: Effort | None = None
    effort_target: str | None = None
    undoes: str | None = None

    def __post_init__(self) -> None:
        if not self.author.strip():
            raise ProjectError("a change needs an author; pass a name that is not empty")


@dataclass(frozen=True)
class FramePart:
    """The changes of one frame within an action over several frames."""

    frame_id: int
    payloads: Sequence[Payload]
    context: WriteContext


class Write:
    """Changes of one frame, or of what belongs to none, within one transaction; `finish` stores them.

    Attributes:
        frame_id: None for a view without a frame, and for the classes.
        where: names it in messages.
        terms: of the transaction.
        config: of the project.
    """

    def __init__(
        self,
        writer: Writer,
        connection: Connection,
        frame_id: int | None,
        where: str,
        context: WriteContext,
        action: str | None = None,
        config: ProjectConfig | None = None,
        terms: Terms | None = None,
    ) -> None:
        self.connection, self.frame_id, self.where, self.context = connection, frame_id, where, context
        self.terms = Terms(connection) if terms is None else terms
        self.time_ns = writer.store.clock()
        self._folder, self._config, self._action = writer.folder, config, action
        # the known rows, with what was put in their places
        self._now: dict[tuple[str, Key], Row | None] = {}
        self._knows_all = False
        self._rows: list[RowChange] = []
        self._events: list[tuple[str, str | None, tuple[RowChange, ...]]] = []
        self._pass: tuple[int | None, str] | None = None
        self._next_id: int | None = None

    @property
    def config(self) -> ProjectConfig:
        """The project's configuration, read from the file: another process may have added a class."""
        if self._config is None:
            self._config = read_config(self._folder)
        return self._config

    @property
    def author(self) -> Row:
        """The columns of who changes a row, and when."""
        return {"author": self.context.author, "time_ns": self.time_ns}

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
        if (change := changed_row(table, key, before, after)) is not None:
            self._now[table, key] = after
            self._rows.append(change)

    def label(self, uid: str) -> Row:
        """The row of a label of the frame.

        Raises:
            ProjectError: there is none.
        """
        row = self.row("labels", uid)
        if row is None or row["frame_id"] != self.frame_id:
            raise ProjectError(
                f"{self.where}: label {uid} is not in this frame; it may have been deleted; reload the frame"
            )
        return row

    def know(self, table: str, key: Key, row: Row) -> None:
        """Takes a row that was read within the transaction."""
        self._now.setdefault((table, key), row)

    def know_all(self, rows: Iterable[Row]) -> None:
        """Takes the rows of all labels of the frame, read within the transaction."""
        for row in rows:
            self.know("labels", row["uid"], row)
        self._knows_all = True

    def labels(self) -> list[Row]:
        """The rows of all labels of the frame, in the order of their creation."""
        if not self._knows_all:
            columns = columns_of("labels")
            query = f"SELECT {', '.join(columns)} FROM labels WHERE frame_id = ?"
            found = driver_of(self.connection).execute(query, (self.frame_id,)).fetchall()
            self.know_all(dict(zip(columns, values, strict=True)) for values in found)
        now = [row for (table, _), row in self._now.items() if table == "labels" and row is not None]
        return sorted((row for row in now if row["frame_id"] == self.frame_id), key=lambda row: int(row["id"]))

    def next_label_id(self) -> int:
        """An id that no label has ever had."""
        if self._next_id is None:
            given = (
                driver_of(self.connection).execute("SELECT seq FROM sqlite_sequence WHERE name = 'labels'").fetchone()
            )
            self._next_id = 0 if given is None else int(given[0])
        self._next_id += 1
        return self._next_id

    def class_id(self, name: str) -> int:
        """The id of a class of the project; one that no row has had yet gets one.

        Raises:
            ProjectError: an unknown class.
        """
        if name not in self.config.classes:
            raise ProjectError(
                f"{self.where}: {name!r} is not a class of the project; {alternatives(name, self.config.classes)}; "
                "use one of the project's classes, or add the missing ones to the project first"
            )
        known = self.terms.known_id(name)
        if known is None:
            known = self.terms.add(name)
            self._now["classes", known] = None
            self.put("classes", known, {"id": known, "name": name})
        return known

    # --- events -------------------------------------------------------------------------------------------------------

    def event(self, kind: str, view: str | None = None) -> None:
        """Ends one change: the rows that were put since the one before."""
        self._events.append((kind, view, tuple(as_one(self._rows))))
        self._rows = []

    def keep_pass(self, run: int | None, content: str) -> None:
        """Keeps the traces of an automatic pass in the place of those of the one before."""
        self._pass = run, content

    def finish(self) -> Receipt:
        """Stores the rows and the events.

        Raises:
            TrackTakenError: a track would get a second box in the frame.
        """
        context, stored = self.context, list[Event]()
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
        if self._pass is not None:
            run, content = self._pass
            values = (self.frame_id, stored[0].id, run, packed(content))
            self.connection.exec_driver_sql("INSERT OR REPLACE INTO passes VALUES (?, ?, ?, ?)", values)
        return Receipt(tuple(event.id for event in stored), context.revision + len(stored))

    def _apply(self, stored: list[Event]) -> None:
        try:
            apply_events(self.connection, stored)
        except sqlite3.IntegrityError as error:
            if "track_id" not in str(error) and "one_box_a_track" not in str(error):
                raise
            track_id = self._track_with_two()
            raise TrackTakenError(
                f"{self.where}: track {track_id} has a box in this frame already, and an object has one box in a frame; "
                "give one of them another track, or delete the other box",
                track_id,
            ) from error
        if self.frame_id is not None:
            newer = "UPDATE frames SET revision = ? WHERE id = ?"
            driver_of(self.connection).execute(newer, (stored[-1].revision, self.frame_id))

    def _track_with_two(self) -> int:
        """The track with two boxes in the frame, after an attempt to store both."""
        seen = set[int]()
        for row in self.labels():
            if row["track_id"] is not None and row["state"] != ReviewState.REJECTED.value:
                if row["track_id"] in seen:
                    return int(row["track_id"])
                seen.add(row["track_id"])
        raise ProjectError(f"{self.where}: a track has two boxes in this frame")


@dataclass(frozen=True, eq=False)
class Writer:
    """Changes a project.

    Attributes:
        store: the database.
        folder: the project's folder, whose `project.json` names the classes.
    """

    store: Store
    folder: Path

    def to_frame(
        self, frame_id: int, payloads: Sequence[Payload], context: WriteContext, action: str | None = None
    ) -> Receipt:
        """Changes one frame, all or nothing; `action` as in `to_frames`.

        Raises:
            StaleRevisionError: the frame has changed since `context.revision`.
            FinalisedFrameError: an automatic pass may not change a finalised frame.
            TrackTakenError: a track would get a second box in the frame.
            ProjectError: an unknown frame, label or class; or the database cannot be written.
        """
        if self.store.write_lock.locked():
            # rejects a stale change without waiting for the lock
            with self.store.read() as connection:
                require_writable(connection, frame_id, context)
        with self.store.write() as connection:
            return self.to_frame_in(connection, frame_id, payloads, context, action)

    def to_frame_in(
        self,
        connection: Connection,
        frame_id: int,
        payloads: Sequence[Payload],
        context: WriteContext,
        action: str | None = None,
    ) -> Receipt:
        """As `to_frame`, within the caller's write transaction, as a part of an action over several frames if any."""
        where = require_writable(connection, frame_id, context)
        is_action = _is_undoable(context, action) and not any(
            isinstance(payload, ProposalsReplaced | TracksLinked) for payload in payloads
        )
        write = Write(self, connection, frame_id, where, context, (action or new_action()) if is_action else None)
        for payload in payloads:
            with storable(f"{where}: {payload.kind}"):
                make(write, payload)
        return write.finish()

    def to_frames(
        self, parts: Sequence[FramePart], action: str | None = None, new_tracks: Collection[int] = ()
    ) -> tuple[Receipt, ...]:
        """Changes several frames as one action, all or nothing; the first part's effort is that of the action.

        Args:
            action: id of an action that is written in several calls (`new_action`); None = a new one.
            new_tracks: track ids that must still be free in the recording of the first part's frame.
        """
        with self.store.write() as connection:
            if new_tracks:
                _require_free(connection, parts[0].frame_id, new_tracks)
            return self.to_frames_in(connection, parts, action)

    def to_frames_in(
        self, connection: Connection, parts: Sequence[FramePart], action: str | None = None
    ) -> tuple[Receipt, ...]:
        """As `to_frames`, within the caller's write transaction."""
        action = action or new_action()
        return tuple(self.to_frame_in(connection, part.frame_id, part.payloads, part.context, action) for part in parts)

    def to_view(self, payload: ViewBoxesSet, context: WriteContext) -> Receipt:
        """Sets boxes on a pseudo-view that belongs to no frame of the project.

        Raises:
            StaleRevisionError: the view has changed since `context.revision` (0 for an unlabelled view).
            ProjectError: an unknown class; or the database cannot be written.
        """
        where = f"view {payload.view[:12]}"
        with self.store.write() as connection:
            of_view = (events.c.view_id == payload.view) & events.c.frame_id.is_(None)
            revision = connection.execute(select(func.max(events.c.revision)).where(of_view)).scalar() or 0
            if revision != context.revision:
                raise StaleRevisionError(where, context.revision, revision)
            write = Write(self, connection, None, where, context)
            with storable(f"{where}: {payload.kind}"):
                make(write, payload)
            return write.finish()


def new_action() -> str:
    """Returns an id for an action."""
    return uuid.uuid4().hex


def _is_undoable(context: WriteContext, action: str | None) -> bool:
    """True for changes that an operator can undo; an import is one if its caller says so, by passing an action."""
    return context.source is Source.MANUAL or (context.source is Source.IMPORTED and action is not None)


def import_action(context: WriteContext, action: str | None) -> str | None:
    """The action of an import: the one that its caller passes."""
    return action if _is_undoable(context, action) else None


def _require_free(connection: Connection, frame_id: int, tracks: Collection[int]) -> None:
    recording = select(frames.c.recording_id).where(frames.c.id == frame_id).scalar_subquery()
    used = (
        select(ALL_LABELS.c.track_id)
        .join(frames, frames.c.id == ALL_LABELS.c.frame_id)
        .where(frames.c.recording_id == recording, ALL_LABELS.c.track_id.in_(tracks))
        .limit(1)
    )
    track_id = connection.execute(used).scalar()
    if track_id is not None:
        raise TrackTakenError(f"track {track_id} has been given to another object in the meantime; try again", track_id)


def require_writable(connection: Connection, frame_id: int, context: WriteContext) -> str:
    """Checks that the frame may be changed; returns its name for messages."""
    row = connection.execute(_FRAME, {"frame": frame_id}).first()
    if row is None:
        raise NotFoundError(f"the project has no frame with id {frame_id}")
    where = f"frame {row.key} of recording {row.name}"
    if row.removed_ns is not None:
        raise NotFoundError(f"{where}: the recording was removed from the project; add it again to change its labels")
    if row.finalised and context.source is Source.AUTO:
        raise FinalisedFrameError(f"{where} is finalised, so automatic passes may not change it; reopen it first")
    if row.revision != context.revision:
        raise StaleRevisionError(where, context.revision, row.revision)
    return where


# --- what each change does --------------------------------------------------------------------------------------------


def make(write: Write, payload: Payload) -> None:
    """Makes one change."""
    view = None
    match payload:
        case ImageBoxesSet():
            _set_boxes(write, payload, "image_labels", {"frame_id": write.frame_id})
        case ViewBoxesSet():
            view = payload.view
            key = view_key(view, write.frame_id)
            if payload.geometry is not None and payload.geometry.image_box is not None:
                write.class_id(payload.geometry.image_box.label)
            geometry = write.terms.geometry_json(payload.geometry, write.frame_id)
            place = {"key": key, "view_id": view, "frame_id": write.frame_id}
            _set_boxes(write, payload, "view_labels", place | {"step": payload.step, "geometry": geometry})
        case ViewBoxesRemoved():
            view = payload.view
            write.put("view_labels", view_key(view, write.frame_id), None)
        case LabelCreated() | LabelProposed():
            _create(write, payload)
        case ProposalsReplaced():
            _replace_proposals(write, payload)
        case TracksLinked():
            for linked in payload.labels:
                _link(write, linked)
        case LabelAccepted() | LabelRejected():
            state = ReviewState.ACCEPTED if isinstance(payload, LabelAccepted) else ReviewState.REJECTED
            write.put("labels", payload.uid, write.label(payload.uid) | write.author | {"state": state.value})
        case LabelEdited():
            _edit(write, payload)
        case LabelMoved():
            box = write.terms.box_json(payload.box, write.frame_id)
            write.put("labels", payload.uid, write.label(payload.uid) | write.author | {"box": box})
        case LabelTracked():
            row = write.label(payload.uid)
            name = write.terms.names[row["class_id"]]
            write.put("labels", payload.uid, row | write.author | _tracked(write, row, name, name, payload.track_id))
        case LabelAttributesSet():
            _set_values(write, payload)
        case LabelDeleted():
            write.label(payload.uid)
            write.put("labels", payload.uid, None)
        case FrameAttributesSet():
            _set_frame_values(write, payload.attributes)
        case FrameFinalised() | FrameReopened():
            _set_finalised(write, isinstance(payload, FrameFinalised))
        case _:
            raise TypeError(f"{payload.kind} is no change that the store knows")
    write.event(payload.kind, view)


def view_key(view_id: str, frame_id: int | None) -> str:
    """The key of a row of `view_labels`."""
    return f"{view_id}:{'' if frame_id is None else frame_id}"


def _set_boxes(write: Write, payload: ImageBoxesSet | ViewBoxesSet, table: str, place: Row) -> None:
    for box in payload.boxes:
        write.class_id(box.label)
    row = {
        "box_kind": payload.box_kind.value,
        "boxes": write.terms.boxes_2d_json(payload.boxes),
        "count": len(payload.boxes),
        "source": write.context.source.value,
    }
    write.put(table, next(iter(place.values())), _in_order(table, place | row | write.author))


def _in_order(table: str, row: Row) -> Row:
    return {name: row[name] for name in columns_of(table)}


def new_label(write: Write, uid: str, label: str, **values: Any) -> Row:
    """The row of a new label; columns that are not given have no value."""
    row: Row = dict.fromkeys(columns_of("labels"))
    row |= {"id": write.next_label_id(), "uid": uid, "frame_id": write.frame_id, "class_id": write.class_id(label)}
    row |= {"source": write.context.source.value, "track_linked": 0, "values_set": 0, "attributes": "{}"}
    return row | write.author | values


def said_json(write: Write, said: Sequence[SaidRecord]) -> str | None:
    """What sources say of an object as it is stored; their classes are those of the project."""
    for each in said:
        if write.terms.known_id(each.label) is None:
            write.class_id(each.label)
    return write.terms.said_json(said, write.frame_id)


def found_columns(write: Write, proposal: ProposalRecord) -> Row:
    """The columns of a label that come from the recursion."""
    quality = proposal.quality
    return {
        "score": proposal.score,
        "proposed_box": write.terms.box_json(proposal.box, write.frame_id),
        "view_disagreement": number_or_none(quality.view_disagreement),
        "kept_share": number_or_none(quality.kept_share),
        "last_change": number_or_none(quality.last_change),
        "image_agreement": number_or_none(quality.image_agreement),
        "expected_iou_loss": number_or_none(quality.expected_iou_loss),
    }


def _attributes_of(write: Write, label: str) -> list[Attribute]:
    return [each for each in write.config.attributes if each.is_of(label)]


def _values_of_tracks(write: Write, tracks: Collection[int | None]) -> Mapping[int | None, Values]:
    return of_tracks(write.connection, write.terms, write.config.attributes, write.frame_id, tracks)


def _create(write: Write, payload: LabelCreated | LabelProposed) -> None:
    if write.row("labels", payload.uid) is not None:
        raise ProjectError(f"{write.where}: label {payload.uid} exists already")
    if payload.image_box is not None if isinstance(payload, LabelCreated) else False:
        write.class_id(payload.image_box.label)
    of_label = _attributes_of(write, payload.label)
    row = new_label(
        write,
        payload.uid,
        payload.label,
        box=write.terms.box_json(payload.box, write.frame_id),
        track_id=payload.track_id,
        origin=None if payload.origin is None else payload.origin.value,
        box_kind=payload.box_kind.value,
        said=said_json(write, payload.said),
    )
    given: Values
    if isinstance(payload, LabelCreated):
        given = checked(of_label, payload.attributes, payload.label)
        row |= {"score": payload.score, "state": payload.state.value}
        row |= {"image_box": write.terms.box_2d_json(payload.image_box)}
        row |= {"suggestion": suggestion_json(payload.suggestion)}
    else:
        given = fitting(of_label, payload.attributes)
        row |= {"state": ReviewState.PROPOSED.value, "source": Source.AUTO.value}
        row |= {"track_linked": int(payload.track_id is not None)}
        row |= {} if payload.proposal is None else found_columns(write, payload.proposal)
    of_track = _values_of_tracks(write, [payload.track_id]).get(payload.track_id, {})
    row["attributes"] = values_json(new_values(of_label, of_track, given))
    write.put("labels", payload.uid, row)


def _replace_proposals(write: Write, payload: ProposalsReplaced) -> None:
    """Applies an automatic pass: its proposals replace the unreviewed labels of the frame, except imported ones."""
    for row in write.labels():
        is_ours = row["state"] == ReviewState.PROPOSED.value and row["source"] != Source.IMPORTED.value
        if is_ours and row["uid"] not in payload.kept:
            write.put("labels", row["uid"], None)
    new = [entry for entry in payload.objects if entry.covered_by is None]
    tracks = _values_of_tracks(write, [entry.track_id for entry in new]) if write.config.attributes else {}
    for entry in new:
        label = entry.proposal.label
        values = new_values(_attributes_of(write, label), tracks.get(entry.track_id, {}), {})
        found = found_columns(write, entry.proposal)
        row = new_label(
            write,
            entry.uid,
            label,
            box=found["proposed_box"],
            state=ReviewState.PROPOSED.value,
            # the source of a proposal is AUTO, whoever started the pass
            source=Source.AUTO.value,
            track_id=entry.track_id,
            track_linked=int(entry.track_id is not None),
            run_id=payload.run,
            box_kind=payload.box_kind.value,
            attributes=values_json(values),
        )
        write.put("labels", entry.uid, row | found)
    write.keep_pass(payload.run, _in_cloud(write, payload).model_dump_json(warnings="error"))


def _in_cloud(write: Write, payload: ProposalsReplaced) -> ProposalsReplaced:
    """A pass with its boxes, but not its traces, in the frame of the cloud."""
    if (T := write.terms.T_camera_cloud(write.frame_id)) is None:
        return payload
    moved = [
        entry.model_copy(
            update={"proposal": entry.proposal.model_copy(update={"box": moved_box(entry.proposal.box, T.inv())})}
        )
        for entry in payload.objects
    ]
    return payload.model_copy(update={"objects": tuple(moved)})


def _link(write: Write, linked: LinkedLabel) -> None:
    row = write.row("labels", linked.uid)
    # linking never changes a reviewed box
    is_free = linked.box is None or (row is not None and row["state"] == ReviewState.PROPOSED.value)
    if row is None or row["frame_id"] != write.frame_id or not is_free:
        raise ProjectError(
            f"{write.where}: label {linked.uid} is not in this frame, or has been reviewed since; link the tracks again"
        )
    changed: Row = {"attributes": values_json(values_of(row["attributes"]) | linked.attributes)}
    if linked.track_id is not None:
        changed |= {"track_id": linked.track_id, "track_linked": 1}
    if linked.box is not None:
        changed["box"] = write.terms.box_json(linked.box, write.frame_id)
    write.put("labels", linked.uid, row | changed)


def _edit(write: Write, payload: LabelEdited) -> None:
    row, terms = write.label(payload.uid), write.terms
    # An edit that keeps the box gets it bit for bit: the page's box has other last digits. Otherwise, the edit would
    # count as a correction of a suggested box.
    present = terms.record(row["box"], write.frame_id)
    is_kept = same_box(present.box(), payload.box.box())
    changed: Row = {"class_id": write.class_id(payload.label), "state": ReviewState.EDITED.value}
    if not is_kept:
        changed["box"] = terms.box_json(payload.box, write.frame_id)
    if payload.image_box is not None:
        write.class_id(payload.image_box.label)
        changed["image_box"] = terms.box_2d_json(payload.image_box)
    if payload.box_kind is not None:
        changed["box_kind"] = payload.box_kind.value
    if payload.suggestion is not None:
        changed["suggestion"] = suggestion_json(payload.suggestion)
    elif row["suggestion"] is not None and not is_kept:
        changed["suggestion"] = json.dumps(json.loads(row["suggestion"]) | {"corrected": True}, separators=(",", ":"))
    before = terms.names[row["class_id"]]
    changed |= _tracked(write, row, before, payload.label, payload.track_id)
    write.put("labels", payload.uid, row | write.author | changed)


def _tracked(write: Write, row: Row, before: str, after: str, track_id: int | None) -> Row:
    """What changes of a label with its class and its track; a track set by linking stays one if the id is the same."""
    is_other = track_id != row["track_id"]
    changed: Row = {"track_id": track_id, "track_linked": 0 if is_other else row["track_linked"]}
    if write.config.attributes and (is_other or after != before):
        of_track = _values_of_tracks(write, [track_id]).get(track_id, {}) if is_other else {}
        present = values_of(row["attributes"])
        changed["attributes"] = values_json(after_edit(write.config.attributes, present, before, after, of_track))
    return changed


def _set_values(write: Write, payload: LabelAttributesSet) -> None:
    row = write.row("labels", payload.uid)
    if row is None or row["frame_id"] != write.frame_id:
        raise NotFoundError(
            f"{write.where}: there is no label {payload.uid}; it may have been deleted; reload the frame"
        )
    name = write.terms.names[row["class_id"]]
    given = {key: value for key, value in payload.attributes.items() if value is not None}
    both = values_of(row["attributes"]) | dict(payload.attributes) | checked(_attributes_of(write, name), given, name)
    values = {key: value for key, value in both.items() if value is not None}
    is_own = write.context.source is Source.MANUAL and write.context.effort_target in (None, payload.uid)
    changed = {"attributes": values_json(values), "values_set": int(is_own or row["values_set"])}
    write.put("labels", payload.uid, row | write.author | changed)


def _set_frame_values(write: Write, values: Mapping[str, AttributeValue]) -> None:
    assert write.frame_id is not None  # only frames have values
    row = write.row("frames", write.frame_id)
    assert row is not None  # `require_writable` has found it
    of_frames = [each for each in write.config.attributes if each.of is AttributeOf.FRAME]
    # values that stay as they are may be older than the schema
    present = values_of(row["attributes"])
    new = {key: value for key, value in values.items() if not is_same(value, present.get(key))}
    after = dict(values) | checked(of_frames, new, "a frame")
    write.put("frames", write.frame_id, row | {"attributes": values_json(after) if after else None})


def _set_finalised(write: Write, finalised: bool) -> None:
    assert write.frame_id is not None  # only frames are finalised
    row = write.row("frames", write.frame_id)
    assert row is not None  # `require_writable` has found it
    if bool(row["finalised"]) == finalised:
        raise ProjectError(f"{write.where}: the frame is {'already' if finalised else 'not'} finalised")
    write.put("frames", write.frame_id, row | {"finalised": int(finalised)})


# --- reading the log --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ChangedFrame:
    """A changed frame: its latest revision, and the author of its latest event."""

    frame_id: int
    revision: int
    author: str


@dataclass(frozen=True, eq=False)
class Log:
    """The events of a project."""

    writer: Writer

    def append(self, frame_id: int, payloads: Sequence[Payload], context: WriteContext) -> Receipt:
        """Makes several changes of a frame as one action, all or none."""
        return self.writer.to_frame(frame_id, payloads, context)

    def append_to_frames(
        self, parts: Sequence[FramePart], action: str | None = None, new_tracks: Collection[int] = ()
    ) -> tuple[Receipt, ...]:
        """Changes several frames, all or none, as one action that a single undo reverts.

        Args:
            action: id of an action that is written in several calls (`new_action`); None = a new one.
            new_tracks: track ids that must still be free in the recording of the first part's frame.
        """
        return self.writer.to_frames(parts, action, new_tracks)

    def of_frame(self, frame_id: int) -> tuple[Event, ...]:
        """All events of a frame, in order."""
        with self.writer.store.read() as connection:
            return tuple(read_events(connection, select(events).where(events.c.frame_id == frame_id)))

    def since(self, event_id: int = 0) -> Iterator[Event]:
        """Yields all events after `event_id`, in order, as of the start of the iteration."""
        with self.writer.store.read() as connection:
            yield from read_events(connection, after=event_id)

    def last(self) -> int:
        """The id of the newest event; 0 if there is none."""
        with self.writer.store.read() as connection:
            return int(connection.execute(select(func.coalesce(func.max(events.c.id), 0))).scalar_one())

    def changed_frames(self, event_id: int) -> tuple[int, tuple[ChangedFrame, ...]]:
        """The id of the newest event, and the frames changed after the event `event_id`."""
        last = func.max(events.c.id)
        changed = (
            select(events.c.frame_id, events.c.revision, events.c.author, last)
            .where(events.c.id > event_id, events.c.frame_id.is_not(None))
            .group_by(events.c.frame_id)  # SQLite takes the other columns from the row with the maximum
            .order_by(last)
        )
        with self.writer.store.read() as connection:
            newest = int(connection.execute(select(func.coalesce(last, 0))).scalar_one())
            if newest <= event_id:
                return newest, ()
            return newest, tuple(ChangedFrame(row[0], row[1], row[2]) for row in connection.execute(changed))

    def rebuild(self) -> int:
        """Makes the audited tables anew from all events, of which it returns the number; an intact state stays."""
        with self.writer.store.write() as connection:
            return rebuild(connection)
