"""The event log of a project: appending, reading, and rebuilding the derived tables from it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

from sqlalchemy import func, select

from annotator.project.database.schema import events
from annotator.project.derived import rebuild
from annotator.project.event_types import Payload
from annotator.project.events import Event, read_events
from annotator.project.writing import FramePart, Receipt, WriteContext, Writer


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
        """Appends several events to a frame as one action, all or none.

        Raises:
            StaleRevisionError, FinalisedFrameError, ProjectError: as `Writer.to_frame`.
        """
        return self.writer.to_frame(frame_id, payloads, context)

    def append_to_frames(
        self, parts: Sequence[FramePart], action: str | None = None, new_tracks: Collection[int] = ()
    ) -> tuple[Receipt, ...]:
        """Appends events to several frames, all or none, as one action that a single undo reverts.

        Args:
            action: id of an action that is written in several calls (`new_action`); None = a new one.
            new_tracks: track ids that must still be free in the recording of the first part's frame.

        Raises:
            TrackTakenError, StaleRevisionError, FinalisedFrameError, ProjectError: as `Writer.to_frames`.
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
        """Rebuilds the derived tables from all events; returns the number of events. An intact state does not change.

        Raises:
            ProjectError: an event contradicts the ones before it; the tables stay as they were.
        """
        with self.writer.store.write() as connection:
            return rebuild(connection)
