"""Frames of a project: index, revision, finalisation."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

from sqlalchemy import Connection, bindparam, func, select

from annotator.project.audit.writing import Receipt, WriteContext
from annotator.project.changes import FrameAttributesSet, FrameFinalised
from annotator.project.database.schema import AnyRow, frames
from annotator.project.log import Writer
from annotator.project.recordings import KEPT, of_rig
from annotator.project.rows import values_of
from annotator.types.errors import NotFoundError, ProjectError
from annotator.types.label import AttributeValue


@dataclass(frozen=True)
class StoredFrame:
    """A frame of a recording: what one camera sees of a moment, that is of one cloud.

    Attributes:
        index: its index in the recording's latest scan, or None if that scan did not find it.
        revision: number of changes of its moment so far; the next change must be based on it.
        moment_id: the same for the frames of all cameras that share the cloud, and with it the labels.
    """

    id: int
    recording_id: int
    key: str
    index: int | None
    revision: int
    finalised: bool
    moment_id: int


@dataclass(frozen=True, eq=False)
class Frames:
    """Finds frames, finalises and reopens them."""

    writer: Writer

    def get(self, frame_id: int) -> StoredFrame:
        """One frame."""
        with self.writer.store.read() as connection:
            row = connection.execute(_FRAME, {"frame": frame_id}).first()
        if row is None:
            raise NotFoundError(f"the project has no frame with id {frame_id}")
        return frame_of(row)

    def find(self, recording_id: int, key: str) -> StoredFrame:
        """The frame with that key."""
        same = (frames.c.recording_id == recording_id) & (frames.c.key == key)
        with self.writer.store.read() as connection:
            row = connection.execute(select(frames).where(same)).first()
        if row is None:
            raise ProjectError(
                f"recording {recording_id} has no frame {key!r}; if the frame is new, scan the recording again"
            )
        return frame_of(row)

    def numbers(self, frame_ids: Collection[int]) -> dict[int, int]:
        """As `numbers_of`."""
        with self.writer.store.read() as connection:
            return numbers_of(connection, frame_ids)

    def of(self, recordings: Sequence[int] | None = None) -> tuple[StoredFrame, ...]:
        """The frames of some recordings (default: all) in order; those without an index come last."""
        order = (frames.c.recording_id, frames.c.position.nulls_last(), frames.c.id)
        query = select(*FRAME_COLUMNS).where(KEPT).order_by(*order)
        if recordings is not None:
            query = query.where(frames.c.recording_id.in_(recordings))
        with self.writer.store.read() as connection:
            return tuple(StoredFrame(*row) for row in connection.execute(query))

    def finalised(self, recording_id: int) -> frozenset[int]:
        """Ids of the finalised frames of a recording's rig."""
        with self.writer.store.read() as connection:
            query = select(frames.c.id).where(frames.c.finalised.is_(True), of_rig(recording_id))
            return frozenset(connection.execute(query).scalars())

    def first(self, recording_id: int | None = None) -> int | None:
        """Id of the first frame of a recording (default: of the project) that the latest scan found; None without."""
        query = select(frames.c.id).where(frames.c.position.is_not(None), KEPT)
        if recording_id is not None:
            query = query.where(frames.c.recording_id == recording_id)
        query = query.order_by(frames.c.recording_id, frames.c.position).limit(1)
        with self.writer.store.read() as connection:
            found: int | None = connection.execute(query).scalar()
        return found

    def count_present(self, recordings: Sequence[int] | None = None) -> int:
        """Number of frames of some recordings (default: all) that the latest scan found."""
        query = select(func.count()).where(frames.c.position.is_not(None))
        if recordings is not None:
            query = query.where(frames.c.recording_id.in_(recordings))
        with self.writer.store.read() as connection:
            return int(connection.execute(query).scalar_one())

    def attributes(self) -> dict[int, dict[str, AttributeValue]]:
        """Values of the attributes of all frames that have any, by the frame's id."""
        query = select(frames.c.id, frames.c.attributes).where(frames.c.attributes.is_not(None), KEPT)
        with self.writer.store.read() as connection:
            return {row.id: values_of(row.attributes) for row in connection.execute(query)}

    def attributes_of(self, frame_id: int) -> dict[str, AttributeValue]:
        """Values of the attributes of one frame."""
        query = select(frames.c.attributes).where(frames.c.id == frame_id, KEPT)
        with self.writer.store.read() as connection:
            return values_of(connection.execute(query).scalar())

    def set_attributes(
        self, frame_id: int, changed: Mapping[str, AttributeValue | None], context: WriteContext
    ) -> Receipt:
        """Sets values of a frame's attributes; None removes one."""
        return self.writer.append(frame_id, (FrameAttributesSet(attributes=dict(changed)),), context)

    def finalise(self, frame_id: int, context: WriteContext) -> Receipt:
        """Protects a frame from automatic passes."""
        return self.writer.append(frame_id, (FrameFinalised(),), context)

    def reopen(self, frame_id: int, context: WriteContext) -> Receipt:
        """Reopens a finalised frame."""
        return self.writer.append(frame_id, (FrameFinalised(finalised=False),), context)


# Those of a `StoredFrame`, in its order.
_OF_FRAME = ("id", "recording_id", "key", "position", "revision", "finalised", "moment_id")
FRAME_COLUMNS = tuple(frames.c[name] for name in _OF_FRAME)
# Built once, since building these frequent queries takes longer than running them.
_FRAME = select(frames).where(frames.c.id == bindparam("frame"), KEPT)


def frame_of(row: AnyRow) -> StoredFrame:
    """The frame of a table row."""
    return StoredFrame(row.id, row.recording_id, row.key, row.position, row.revision, row.finalised, row.moment_id)


def numbers_of(connection: Connection, frame_ids: Collection[int]) -> dict[int, int]:
    """What the page calls each frame: its number, from 1, among those that its recording's latest scan has found.

    Frames that it has not found are left out. `frame_ids`: of a page, not of a whole project, since each is a parameter
    of the query.
    """
    wanted = select(frames.c.id, frames.c.recording_id, frames.c.position)
    wanted = wanted.where(frames.c.id.in_(frame_ids), frames.c.position.is_not(None))
    found: dict[int, int] = {}
    ordered = connection.execute(wanted.order_by(frames.c.recording_id, frames.c.position)).all()
    for recording_id, group in groupby(ordered, key=lambda row: row.recording_id):
        rows = list(group)
        most = rows[-1].position
        before = (frames.c.recording_id == recording_id) & (frames.c.position <= most)
        positions: Sequence[int] = range(most + 1)
        # frames that cannot be read may have been left out
        if connection.execute(select(func.count()).where(before)).scalar_one() <= most:
            query = select(frames.c.position).where(before).order_by(frames.c.position)
            positions = connection.execute(query).scalars().all()
        found |= {row.id: bisect_right(positions, row.position) for row in rows}
    return found
