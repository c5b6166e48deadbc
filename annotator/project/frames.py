"""Frames as the project knows them: place, revision, finalisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, func, select

from annotator.project.payloads import FrameFinalised, FrameReopened
from annotator.project.schema import AnyRow, frames
from annotator.project.writing import Change, Receipt, Writer
from annotator.types.errors import NotFoundError, ProjectError


@dataclass(frozen=True)
class StoredFrame:
    """A frame of a recording.

    Attributes:
        id: within the project.
        recording_id: its recording.
        key: its name within the recording.
        index: its place in the recording's latest scan, or None where that scan no longer found it.
        revision: grows with every change; the next change has to name it.
        finalised: True once an operator is done with it.
    """

    id: int
    recording_id: int
    key: str
    index: int | None
    revision: int
    finalised: bool


@dataclass(frozen=True, eq=False)
class Frames:
    """Finds frames, finalises and reopens them."""

    writer: Writer

    def get(self, frame_id: int) -> StoredFrame:
        """One frame.

        Raises:
            NotFoundError: no such frame.
        """
        with self.writer.store.read() as connection:
            return read_frame(connection, frame_id)

    def find(self, recording_id: int, key: str) -> StoredFrame:
        """The frame of that key.

        Raises:
            NotFoundError: no such frame.
        """
        chosen = (frames.c.recording_id == recording_id) & (frames.c.key == key)
        with self.writer.store.read() as connection:
            row = connection.execute(select(frames).where(chosen)).first()
        if row is None:
            raise ProjectError(f"recording {recording_id} has no frame {key!r}; scan it again if the frame is new")
        return frame_of(row)

    def of(self, recordings: Sequence[int] | None = None) -> tuple[StoredFrame, ...]:
        """The frames of some recordings (all by default) in order; those without an index come last."""
        query = select(frames).order_by(frames.c.recording_id, frames.c.position.nulls_last(), frames.c.id)
        if recordings is not None:
            query = query.where(frames.c.recording_id.in_(recordings))
        with self.writer.store.read() as connection:
            return tuple(map(frame_of, connection.execute(query)))

    def count_present(self, recordings: Sequence[int] | None = None) -> int:
        """How many frames of some recordings (all by default) the latest scan found."""
        query = select(func.count()).where(frames.c.position.is_not(None))
        if recordings is not None:
            query = query.where(frames.c.recording_id.in_(recordings))
        with self.writer.store.read() as connection:
            return int(connection.execute(query).scalar_one())

    def finalise(self, frame_id: int, change: Change) -> Receipt:
        """Close a frame to automatic passes.

        Raises:
            StaleRevisionError: the frame has changed since.
            ProjectError: no such frame, or it is finalised already.
        """
        return self.writer.to_frame(frame_id, (FrameFinalised(),), change)

    def reopen(self, frame_id: int, change: Change) -> Receipt:
        """Open a finalised frame again.

        Raises:
            StaleRevisionError: the frame has changed since.
            FinalisedFrameError: an automatic pass wanted to.
            ProjectError: no such frame, or it is open already.
        """
        return self.writer.to_frame(frame_id, (FrameReopened(),), change)


def read_frame(connection: Connection, frame_id: int) -> StoredFrame:
    """One frame, within the caller's transaction.

    Raises:
        NotFoundError: no such frame.
    """
    row = connection.execute(select(frames).where(frames.c.id == frame_id)).first()
    if row is None:
        raise NotFoundError(f"the project has no frame with id {frame_id}")
    return frame_of(row)


def frame_of(row: AnyRow) -> StoredFrame:
    """The frame that a row of the table holds."""
    return StoredFrame(row.id, row.recording_id, row.key, row.position, row.revision, row.finalised)
