"""The one way to write: revision and finalisation are checked, events appended and applied, all in one transaction."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Connection, func, select

from annotator.project.config import read_config
from annotator.project.derived import apply_event
from annotator.project.events import Effort, Event, insert_event
from annotator.project.payloads import PAYLOAD, Payload, ProposalsReplaced, TracksLinked, ViewBoxesSet
from annotator.project.records import storable
from annotator.project.schema import events, frames, recordings
from annotator.project.store import Store
from annotator.types import Source
from annotator.types.errors import FinalisedFrameError, NotFoundError, ProjectError, StaleRevisionError


@dataclass(frozen=True)
class Receipt:
    """What was acknowledged.

    Attributes:
        event_ids: of the events that were appended, in order.
        revision: that the next change of the same frame (or view) has to name.
    """

    event_ids: tuple[int, ...]
    revision: int


@dataclass(frozen=True)
class Change:
    """Who writes, and what they had seen.

    Attributes:
        revision: of the frame (or view) that the change is based on.
        author: a person's name, or a program's; not empty.
        source: how the change came about.
        effort: what it cost the operator, where that was counted.
        subject: uid of the label, or id of the begun object, that the effort went into; by default the labels changed.
        undoes: the action that this change takes back.
    """

    revision: int
    author: str
    source: Source = Source.MANUAL
    effort: Effort | None = None
    subject: str | None = None
    undoes: str | None = None

    def __post_init__(self) -> None:
        if not self.author.strip():
            raise ProjectError("a change needs an author; give a name")


@dataclass(frozen=True)
class FramePart:
    """What a change to several frames says of one of them."""

    frame_id: int
    payloads: Sequence[Payload]
    change: Change


@dataclass(frozen=True, eq=False)
class Writer:
    """Appends events to a project.

    Attributes:
        store: the database.
        folder: the project's folder, whose `project.json` names the classes.
    """

    store: Store
    folder: Path

    def to_frame(self, frame_id: int, payloads: Sequence[Payload], change: Change) -> Receipt:
        """Append events to one frame, all or none.

        Raises:
            StaleRevisionError: the frame has changed since `change.revision`.
            FinalisedFrameError: an automatic pass wanted to change a finalised frame.
            ProjectError: an unknown frame, label or class; or the database refuses.
        """
        # who comes too late is told so without waiting for those who write
        with self.store.read() as connection:
            require_writable(connection, frame_id, change)
        with self.store.write() as connection:
            return self.to_frame_in(connection, frame_id, payloads, change)

    def to_frame_in(
        self, connection: Connection, frame_id: int, payloads: Sequence[Payload], change: Change
    ) -> Receipt:
        """As `to_frame`, as a part of the caller's write transaction."""
        where = require_writable(connection, frame_id, change)
        return self._append(connection, frame_id, where, payloads, change)

    def to_frames(self, parts: Sequence[FramePart]) -> tuple[Receipt, ...]:
        """Append events to several frames as one action, all or none; the action costs what the first part says.

        Raises:
            StaleRevisionError, FinalisedFrameError, ProjectError: as `to_frame`, of any of the frames.
        """
        with self.store.write() as connection:
            return self.to_frames_in(connection, parts)

    def to_frames_in(self, connection: Connection, parts: Sequence[FramePart]) -> tuple[Receipt, ...]:
        """As `to_frames`, as a part of the caller's write transaction."""
        action, receipts = uuid.uuid4().hex, list[Receipt]()
        for part in parts:
            where = require_writable(connection, part.frame_id, part.change)
            receipts.append(self._append(connection, part.frame_id, where, part.payloads, part.change, action))
        return tuple(receipts)

    def to_view(self, payload: ViewBoxesSet, change: Change) -> Receipt:
        """Append boxes on a pseudo-view that came from no frame of the project.

        Raises:
            StaleRevisionError: the view has changed since `change.revision` (0 for one never labelled).
            ProjectError: an unknown class; or the database refuses.
        """
        where = f"view {payload.view[:12]}"
        with self.store.write() as connection:
            own = (events.c.view_id == payload.view) & events.c.frame_id.is_(None)
            revision = connection.execute(select(func.max(events.c.revision)).where(own)).scalar() or 0
            if revision != change.revision:
                raise StaleRevisionError(where, change.revision, revision)
            return self._append(connection, None, where, (payload,), change)

    def _append(
        self,
        connection: Connection,
        frame_id: int | None,
        where: str,
        payloads: Sequence[Payload],
        change: Change,
        shared: str | None = None,
    ) -> Receipt:
        """`shared`: the action that these events are a part of, where they are one; None = one of their own."""
        self._require_classes(where, payloads)
        time_ns = self.store.clock()
        action = (shared or uuid.uuid4().hex) if _is_action(frame_id, payloads, change) else None
        done: list[Event] = []
        for revision, payload in enumerate(payloads, change.revision + 1):
            content, stored = _encoded(where, payload)
            event = insert_event(
                connection,
                frame_id=frame_id,
                revision=revision,
                content=content,
                payload=stored,
                author=change.author,
                time_ns=time_ns,
                source=change.source,
                action=action,
                undoes=change.undoes,
                subject=change.subject,
                effort=None if done else change.effort,
            )
            _apply(connection, event, where)
            done.append(event)
        return Receipt(tuple(event.id for event in done), change.revision + len(done))

    def _require_classes(self, where: str, payloads: Sequence[Payload]) -> None:
        wanted = set().union(*(payload.classes() for payload in payloads))
        if not wanted:
            return
        # read anew: another process may have added a class since this one opened the project
        known = read_config(self.folder).classes
        if unknown := sorted(wanted - set(known)):
            raise ProjectError(
                f"{where}: {', '.join(map(repr, unknown))} is no class of the project ({', '.join(known)}); "
                "use one of these, or add the class to the project first"
            )


def require_writable(connection: Connection, frame_id: int, change: Change) -> str:
    """The frame's name for messages, where `change` may be made to it.

    Raises:
        FinalisedFrameError, StaleRevisionError, ProjectError: as `Writer.to_frame`.
    """
    query = (
        select(frames.c.key, frames.c.revision, frames.c.finalised, recordings.c.name)
        .join(recordings, recordings.c.id == frames.c.recording_id)
        .where(frames.c.id == frame_id)
    )
    row = connection.execute(query).first()
    if row is None:
        raise NotFoundError(f"the project has no frame with id {frame_id}")
    where = f"frame {row.key} of recording {row.name}"
    if row.finalised and change.source is Source.AUTO:
        raise FinalisedFrameError(f"{where} is finalised; automatic passes leave it alone until it is reopened")
    if row.revision != change.revision:
        raise StaleRevisionError(where, change.revision, row.revision)
    return where


def _is_action(frame_id: int | None, payloads: Sequence[Payload], change: Change) -> bool:
    """True for what an operator may take back: neither automatic passes nor imports."""
    by_hand = frame_id is not None and change.source is Source.MANUAL
    return by_hand and not any(isinstance(payload, ProposalsReplaced | TracksLinked) for payload in payloads)


def _encoded(where: str, payload: Payload) -> tuple[str, Payload]:
    """The payload as JSON, and as it will be read back: the state is made from the latter, now as in a rebuild."""
    with storable(f"{where}: {payload.kind}"):
        content = payload.model_dump_json(warnings="error")
        return content, PAYLOAD.validate_json(content)


def _apply(connection: Connection, event: Event, where: str) -> None:
    try:
        apply_event(connection, event)
    except ProjectError as error:
        raise ProjectError(f"{where}: {error}") from error
