"""Writing to frames, after checks of revision, finalisation and recording, and reading the log."""

from __future__ import annotations

import uuid
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, bindparam, func, select

from annotator.project.audit.events import Event, in_moment_of, read_events, rebuild
from annotator.project.audit.making import make
from annotator.project.audit.writing import Receipt, Write, WriteContext
from annotator.project.changes import Payload, ViewBoxesSet
from annotator.project.database.schema import ALL_LABELS, events, frames, recordings, stills
from annotator.project.database.store import Store, driver_of
from annotator.project.recordings import of_rig
from annotator.project.records import storable
from annotator.project.rows import Terms
from annotator.types import Source
from annotator.types.errors import FinalisedFrameError, NotFoundError, StaleRevisionError, TrackTakenError

# Built once, since building these frequent queries takes longer than running them.
_AT = frames.alias()
_LAST = func.max(events.c.id)
_NEWEST = select(func.coalesce(_LAST, 0))
_CHANGED = (
    select(frames.c.id, events.c.revision, events.c.author, _LAST)
    .join(_AT, _AT.c.id == events.c.frame_id)
    .join(frames, frames.c.moment_id == _AT.c.moment_id)
    .where(events.c.id > bindparam("after"))
    .group_by(frames.c.id)  # SQLite takes the other columns from the row with the maximum
    .order_by(_LAST)
)
# By the driver: an operation on a track writes to thousands of frames.
_FRAME = (
    "SELECT frames.key, frames.revision, frames.finalised, recordings.name, recordings.removed_ns "
    "FROM frames JOIN recordings ON recordings.id = frames.recording_id WHERE frames.id = ?"
)


@dataclass(frozen=True)
class ChangedFrame:
    """A frame of a changed moment: its latest revision, and the author of its latest event."""

    frame_id: int
    revision: int
    author: str


@dataclass(frozen=True)
class FramePart:
    """The changes of one frame within an action over several frames."""

    frame_id: int
    payloads: Sequence[Payload]
    context: WriteContext


@dataclass(frozen=True, eq=False)
class Writer:
    """The log of a project: changes it, and tells what was changed."""

    store: Store

    def append(
        self, frame_id: int, payloads: Sequence[Payload], context: WriteContext, action: str | None = None
    ) -> Receipt:
        """Changes one frame, all or nothing; `action` as in `append_to_frames`."""
        with self.store.write() as connection:
            return self.to_frame_in(connection, frame_id, payloads, context, action)

    def to_frame_in(
        self,
        connection: Connection,
        frame_id: int,
        payloads: Sequence[Payload],
        context: WriteContext,
        action: str | None = None,
        terms: Terms | None = None,
    ) -> Receipt:
        """As `append`, within the caller's write transaction, as a part of an action over several frames if any.

        Args:
            terms: of the transaction, if it writes to several frames.
        """
        where = require_writable(connection, frame_id, context)
        # a pass or an import can be undone if its caller says so, by passing an action
        action = new_action() if action is None and context.source is Source.MANUAL else action
        write = Write(self.store, connection, frame_id, where, context, action, terms)
        for payload in payloads:
            with storable(f"{where}: {payload.kind}"):
                make(write, payload)
        return write.finish()

    def append_to_frames(
        self, parts: Sequence[FramePart], action: str | None = None, new_tracks: Collection[int] = ()
    ) -> tuple[Receipt, ...]:
        """Changes several frames as one action, all or nothing; the first part's effort is that of the action.

        Args:
            action: id of an action that is written in several calls (`new_action`); None = a new one.
            new_tracks: track ids that must still be free in the rig of the first part's frame.
        """
        with self.store.write() as connection:
            if new_tracks:
                here = frames.alias()
                recording = select(here.c.recording_id).where(here.c.id == parts[0].frame_id).scalar_subquery()
                used = select(ALL_LABELS.c.track_id).join(frames, frames.c.id == ALL_LABELS.c.frame_id)
                used = used.where(of_rig(recording), ALL_LABELS.c.track_id.in_(new_tracks))
                rig = select(recordings.c.rig_id).where(recordings.c.id == recording).scalar_subquery()
                still = select(stills.c.track_id).where(stills.c.rig_id == rig, stills.c.track_id.in_(new_tracks))
                if (track_id := connection.execute(used.union_all(still).limit(1)).scalar()) is not None:
                    taken = f"track {track_id} has been given to another object in the meantime; try again"
                    raise TrackTakenError(taken, track_id)
            action, terms = action or new_action(), Terms(connection)
            return tuple(
                self.to_frame_in(connection, each.frame_id, each.payloads, each.context, action, terms)
                for each in parts
            )

    def to_view(self, payload: ViewBoxesSet, context: WriteContext) -> Receipt:
        """Sets boxes on a pseudo-view that belongs to no frame of the project."""
        where = f"view {payload.view[:12]}"
        with self.store.write() as connection:
            revision = next_revision(connection, payload.view) - 1
            if revision != context.revision:
                raise StaleRevisionError(where, context.revision, revision)
            write = Write(self.store, connection, None, where, context)
            with storable(f"{where}: {payload.kind}"):
                make(write, payload)
            return write.finish()

    # --- reading the log ----------------------------------------------------------------------------------------------

    def of_frame(self, frame_id: int) -> tuple[Event, ...]:
        """All events of a frame's moment, in order."""
        with self.store.read() as connection:
            return tuple(read_events(connection, select(events).where(in_moment_of(frame_id))))

    def since(self, event_id: int = 0) -> Iterator[Event]:
        """Yields all events after `event_id`, in order, as of the start of the iteration."""
        with self.store.read() as connection:
            yield from read_events(connection, after=event_id)

    def last(self) -> int:
        """The id of the newest event; 0 if there is none."""
        with self.store.read() as connection:
            return int(connection.execute(_NEWEST).scalar_one())

    def changed_frames(self, event_id: int) -> tuple[int, tuple[ChangedFrame, ...]]:
        """The id of the newest event, and the frames whose moments changed after the event `event_id`."""
        with self.store.read() as connection:
            newest = int(connection.execute(_NEWEST).scalar_one())
            if newest <= event_id:
                return newest, ()
            rows = connection.execute(_CHANGED, {"after": event_id})
            return newest, tuple(ChangedFrame(*row[:3]) for row in rows)

    def rebuild(self) -> int:
        """Makes the audited tables anew from all events, of which it returns the number; an intact state stays."""
        with self.store.write() as connection:
            return rebuild(connection)


def next_revision(connection: Connection, view: str) -> int:
    """The revision of the next event of what belongs to no frame: a view, or the classes."""
    of_view = (events.c.view_id == view) & events.c.frame_id.is_(None)  # as the index has it
    return (connection.execute(select(func.max(events.c.revision)).where(of_view)).scalar() or 0) + 1


def new_action() -> str:
    """Returns an id for an action."""
    return uuid.uuid4().hex


def require_writable(connection: Connection, frame_id: int, context: WriteContext) -> str:
    """Checks that the frame may be changed; returns its name for messages."""
    row = driver_of(connection).execute(_FRAME, (frame_id,)).fetchone()
    if row is None:
        raise NotFoundError(f"the project has no frame with id {frame_id}")
    key, revision, finalised, name, removed_ns = row
    where = f"frame {key} of recording {name}"
    if removed_ns is not None and context.undoes is None:
        raise NotFoundError(f"{where}: the recording was removed from the project; add it again to change its labels")
    if finalised and context.source is Source.AUTO:
        raise FinalisedFrameError(f"{where} is finalised, so automatic passes may not change it; reopen it first")
    if revision != context.revision:
        raise StaleRevisionError(where, context.revision, revision)
    return where
