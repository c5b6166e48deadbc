"""Writing to the log and reading it; a write checks revision, finalisation and tracks, and applies the events."""

from __future__ import annotations

import uuid
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Connection, bindparam, func, select

from annotator.geometry.oriented_box import same_box
from annotator.project.classes.attributes import Attribute
from annotator.project.classes.completing import completed, restored
from annotator.project.config import ProjectConfig, read_config
from annotator.project.database.schema import events, frames, labels, recordings
from annotator.project.database.store import Store
from annotator.project.log.derived import apply_event, rebuild
from annotator.project.log.event_types import (
    PAYLOAD,
    ClassesChanged,
    FrameAttributesSet,
    LabelAttributesSet,
    LabelEdited,
    LabelTracked,
    Payload,
    ProposalsImported,
    ProposalsReplaced,
    RecordingAdjusted,
    TracksLinked,
    ViewBoxesSet,
)
from annotator.project.log.events import CLASSES, Effort, Event, insert_event, read_events
from annotator.project.log.records import BoxRecord, parsed, storable
from annotator.types import ReviewState, Source
from annotator.types.errors import FinalisedFrameError, NotFoundError, ProjectError, StaleRevisionError, TrackTakenError
from annotator.types.messages import alternatives

# Events without class names that concern attributes.
_OF_ATTRIBUTES = (LabelTracked, LabelAttributesSet, FrameAttributesSet, ProposalsImported)


# Built once, since building these frequent queries takes longer than running them.
_FRAME = (
    select(frames.c.key, frames.c.revision, frames.c.finalised, recordings.c.name, recordings.c.removed_ns)
    .join(recordings, recordings.c.id == frames.c.recording_id)
    .where(frames.c.id == bindparam("frame"))
)
_BOX = select(labels.c.box).where(labels.c.uid == bindparam("uid"))
_SEVERAL_BOXES = (
    select(labels.c.track_id, func.count().label("boxes"))
    .where(labels.c.frame_id == bindparam("frame"), labels.c.state != ReviewState.REJECTED.value)
    .where(labels.c.track_id.is_not(None))
    .group_by(labels.c.track_id)
    .having(func.count() > 1)
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
    """The events for one frame within an action over several frames."""

    frame_id: int
    payloads: Sequence[Payload]
    context: WriteContext


@dataclass(frozen=True, eq=False)
class Writer:
    """Appends events to a project.

    Attributes:
        store: the database.
        folder: the project's folder, whose `project.json` names the classes.
    """

    store: Store
    folder: Path

    def to_frame(
        self, frame_id: int, payloads: Sequence[Payload], context: WriteContext, action: str | None = None
    ) -> Receipt:
        """Appends events to one frame, all or none; `action` as in `to_frames`.

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
        config: ProjectConfig | None = None,
    ) -> Receipt:
        """As `to_frame`, within the caller's write transaction, as a part of an action over several frames if any.

        Args:
            config: of the project, if the caller has read it within the transaction.
        """
        where = require_writable(connection, frame_id, context)
        return self._append(connection, frame_id, where, payloads, context, action, config)

    def to_frames(
        self, parts: Sequence[FramePart], action: str | None = None, new_tracks: Collection[int] = ()
    ) -> tuple[Receipt, ...]:
        """Appends events to several frames as one action, all or none; the first part's effort is that of the action.

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
        action, receipts = action or new_action(), list[Receipt]()
        for part in parts:
            where = require_writable(connection, part.frame_id, part.context)
            receipts.append(self._append(connection, part.frame_id, where, part.payloads, part.context, action))
        return tuple(receipts)

    def to_view(self, payload: ViewBoxesSet, context: WriteContext) -> Receipt:
        """Appends boxes on a pseudo-view that belongs to no frame of the project.

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
            return self._append(connection, None, where, (payload,), context)

    def to_classes_in(
        self,
        connection: Connection,
        payload: ClassesChanged,
        author: str,
        before: Iterable[tuple[int, ProposalsImported]] = (),
    ) -> None:
        """Appends a change of the classes, within the caller's write transaction.

        Args:
            before: what goes before it, by frame id; the frame may be finalised, or of a removed recording.
        """
        for frame_id, shown in before:
            revision = connection.execute(select(frames.c.revision).where(frames.c.id == frame_id)).scalar_one()
            context = WriteContext(revision, author, Source.IMPORTED)
            self._append(connection, frame_id, f"frame with id {frame_id}", (shown,), context)
        query = select(func.max(events.c.revision)).where(events.c.view_id == CLASSES)
        context = WriteContext(connection.execute(query).scalar() or 0, author)
        self._append(connection, None, "the classes", (payload,), context)

    def _append(
        self,
        connection: Connection,
        frame_id: int | None,
        where: str,
        payloads: Sequence[Payload],
        context: WriteContext,
        shared_action: str | None = None,
        config: ProjectConfig | None = None,
    ) -> Receipt:
        """`shared_action`: id of the action over several frames that the events belong to; None = a new action."""
        attributes = self._require_classes(where, payloads, config)
        time_ns = self.store.clock()
        action = (shared_action or new_action()) if _is_action(frame_id, payloads, context, shared_action) else None
        before = _tracks_with_several_boxes(connection, frame_id)
        appended: list[Event] = []
        for revision, payload in enumerate(payloads, context.revision + 1):
            whole = _completed(connection, payload)
            if context.undoes is None:
                whole = completed(connection, attributes, frame_id, whole)
            else:
                whole = restored(connection, attributes, frame_id, whole)
            content, stored = _encoded(where, whole)
            event = Event(
                id=0,
                frame_id=frame_id,
                view_id=None,
                revision=revision,
                author=context.author,
                time_ns=time_ns,
                source=context.source,
                payload=stored,
                action=action,
                undoes=context.undoes,
                effort_target=context.effort_target,
                effort=None if appended else context.effort,
            )
            event = insert_event(connection, event, content)
            _apply(connection, event, where)
            appended.append(event)
        for track_id, boxes in _tracks_with_several_boxes(connection, frame_id).items():
            # a repair that lacks events can leave some until somebody mends them; `annotator check` finds them
            if boxes > before.get(track_id, 1):
                raise TrackTakenError(
                    f"{where}: track {track_id} has a box in this frame already, and an object has one box in a frame; "
                    "give one of them another track, or delete the other box",
                    track_id,
                )
        return Receipt(tuple(event.id for event in appended), context.revision + len(appended))

    def _require_classes(
        self, where: str, payloads: Sequence[Payload], config: ProjectConfig | None
    ) -> tuple[Attribute, ...]:
        """Refuses unknown classes; returns the project's attributes where the events may need them."""
        used = set().union(*(payload.classes() for payload in payloads))
        if not used and not any(isinstance(payload, _OF_ATTRIBUTES) for payload in payloads):
            return ()
        # read from the file: another process may have added a class
        config = config or read_config(self.folder)
        known = config.classes
        if unknown := sorted(used - set(known)):
            is_not = "is not a class" if len(unknown) == 1 else "are not classes"
            raise ProjectError(
                f"{where}: {', '.join(map(repr, unknown))} {is_not} of the project; {alternatives(unknown[0], known)}; "
                "use one of the project's classes, or add the missing ones to the project first"
            )
        return config.attributes


def new_action() -> str:
    """Returns an id for an action."""
    return uuid.uuid4().hex


def _require_free(connection: Connection, frame_id: int, tracks: Collection[int]) -> None:
    recording = select(frames.c.recording_id).where(frames.c.id == frame_id).scalar_subquery()
    used = (
        select(labels.c.track_id)
        .join(frames, frames.c.id == labels.c.frame_id)
        .where(frames.c.recording_id == recording, labels.c.track_id.in_(tracks))
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


def _tracks_with_several_boxes(connection: Connection, frame_id: int | None) -> dict[int, int]:
    """The number of boxes of each track that has more than one in a frame; rejected ones do not count."""
    return {row.track_id: row.boxes for row in connection.execute(_SEVERAL_BOXES, {"frame": frame_id})}


def _is_action(frame_id: int | None, payloads: Sequence[Payload], context: WriteContext, action: str | None) -> bool:
    """True for changes that an operator can undo: not automatic passes, or changes without a frame.

    An import is one if its caller says so, by passing the id of an action.
    """
    undoable = context.source is Source.MANUAL or (context.source is Source.IMPORTED and action is not None)
    by_hand = frame_id is not None and undoable
    return by_hand and not any(isinstance(payload, ProposalsReplaced | TracksLinked) for payload in payloads)


def _completed(connection: Connection, payload: Payload) -> Payload:
    """The payload with what only the store knows.

    An edit that keeps the label's box gets it bit for bit: the page's box has other last digits. Otherwise, the edit
    would count as a correction of a suggested box. An adjustment of a recording gets its last frame.
    """
    if isinstance(payload, RecordingAdjusted):
        last = select(func.max(frames.c.id)).where(frames.c.recording_id == payload.recording)
        return payload.model_copy(update={"last_frame": connection.execute(last).scalar_one()})
    if not isinstance(payload, LabelEdited):
        return payload
    present = connection.execute(_BOX, {"uid": payload.uid}).scalar()
    if present is None:
        return payload
    box = parsed(BoxRecord.model_validate_json, present)
    return payload.model_copy(update={"box": box}) if same_box(box.box(), payload.box.box()) else payload


def _encoded(where: str, payload: Payload) -> tuple[str, Payload]:
    """The payload as JSON, and parsed again from that JSON, so that the tables are updated as in a rebuild."""
    with storable(f"{where}: {payload.kind}"):
        content = payload.model_dump_json(warnings="error")
        return content, PAYLOAD.validate_json(content)


def _apply(connection: Connection, event: Event, where: str) -> None:
    try:
        apply_event(connection, event)
    except ProjectError as error:
        raise ProjectError(f"{where}: {error}") from error


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
        """Appends several events to a frame as one action, all or none."""
        return self.writer.to_frame(frame_id, payloads, context)

    def append_to_frames(
        self, parts: Sequence[FramePart], action: str | None = None, new_tracks: Collection[int] = ()
    ) -> tuple[Receipt, ...]:
        """Appends events to several frames, all or none, as one action that a single undo reverts.

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
        """Rebuilds the derived tables from all events, of which it returns the number; an intact state stays."""
        with self.writer.store.write() as connection:
            return rebuild(connection)
