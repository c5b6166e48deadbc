"""Reading the log of a project, appending to it freely, and making the present state from it anew."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sqlalchemy import func, select

from annotator.project.derived import rebuild
from annotator.project.events import Event, read_events
from annotator.project.payloads import Payload
from annotator.project.schema import events
from annotator.project.writing import Change, FramePart, Receipt, Writer


@dataclass(frozen=True)
class FrameNews:
    """A frame that has changed: the revision that it has by now, and who said the last thing about it."""

    frame_id: int
    revision: int
    author: str


@dataclass(frozen=True, eq=False)
class Log:
    """The events of a project."""

    writer: Writer

    def append(self, frame_id: int, payloads: Sequence[Payload], change: Change) -> Receipt:
        """Say several things about a frame at once, such as "all of these are accepted": all are kept, or none.

        Raises:
            StaleRevisionError, FinalisedFrameError, ProjectError: as `Writer.to_frame`.
        """
        return self.writer.to_frame(frame_id, payloads, change)

    def append_to_frames(self, parts: Sequence[FramePart]) -> tuple[Receipt, ...]:
        """Say things about several frames as one action, which one undo takes back: all are kept, or none.

        Raises:
            StaleRevisionError, FinalisedFrameError, ProjectError: as `Writer.to_frames`.
        """
        return self.writer.to_frames(parts)

    def of_frame(self, frame_id: int) -> tuple[Event, ...]:
        """Everything that was said about a frame, in order."""
        with self.writer.store.read() as connection:
            return tuple(read_events(connection, select(events).where(events.c.frame_id == frame_id)))

    def since(self, event_id: int = 0) -> Iterator[Event]:
        """All events after one, in order, as of the moment that the first is asked for."""
        with self.writer.store.read() as connection:
            yield from read_events(connection, after=event_id)

    def last(self) -> int:
        """The id of the newest event; 0 where there is none."""
        with self.writer.store.read() as connection:
            return int(connection.execute(select(func.coalesce(func.max(events.c.id), 0))).scalar_one())

    def news(self, event_id: int) -> tuple[int, tuple[FrameNews, ...]]:
        """The id of the newest event, and the frames that were changed after an event, whoever changed them."""
        last = func.max(events.c.id)
        changed = (
            select(events.c.frame_id, events.c.revision, events.c.author, last)
            .where(events.c.id > event_id, events.c.frame_id.is_not(None))
            .group_by(events.c.frame_id)  # SQLite takes the other columns from the row of the maximum
            .order_by(last)
        )
        with self.writer.store.read() as connection:
            newest = int(connection.execute(select(func.coalesce(last, 0))).scalar_one())
            if newest <= event_id:
                return newest, ()
            return newest, tuple(FrameNews(row[0], row[1], row[2]) for row in connection.execute(changed))

    def rebuild(self) -> int:
        """Make the present state from the events anew; returns their number. Nothing should change.

        Raises:
            ProjectError: an event does not fit the ones before it; the state stays as it was.
        """
        with self.writer.store.write() as connection:
            return rebuild(connection)
