"""Estimated poses of recordings: where their cameras were, by what they have seen.

A row for each rig, audited and undone as any other; its JSON needs about 100 bytes a frame, packed in the audit. Where
the clouds lie follows from it (`recordings.place_in_world`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import func, select

from annotator.project.audit.writing import Receipt, Write, WriteContext
from annotator.project.database.schema import estimates, frames, recordings
from annotator.project.log import Writer, new_action, require_writable
from annotator.project.recordings import of_same_rig, require_nothing_still
from annotator.project.records import FRAME_POSES, FramePose, parsed
from annotator.types.errors import ProjectError

KIND = "poses_estimated"


@dataclass(frozen=True, eq=False)
class Estimates:
    """Reads and keeps estimated poses. Each change is an event and an action, which undo reverts."""

    writer: Writer

    def newest(self, recording_id: int) -> int:
        """Id of the event that set the poses of a recording's rig; 0 = they are not estimated."""
        query = select(func.max(estimates.c.event_id)).where(of_same_rig(recording_id))
        with self.writer.store.read() as connection:
            return connection.execute(query).scalar() or 0

    def of(self, recording_id: int) -> tuple[FramePose, ...]:
        """The estimated poses of a recording's frames; none if another camera of its rig has them."""
        query = select(estimates.c.poses).where(estimates.c.recording_id == recording_id)
        with self.writer.store.read() as connection:
            found = connection.execute(query).scalar()
        return () if found is None else parsed(FRAME_POSES.validate_json, found)

    def is_recorded(self, recording_id: int) -> bool:
        """Whether the files of a recording say where its camera was."""
        query = select(frames.c.id).where(frames.c.recording_id == recording_id, frames.c.recorded_world.is_not(None))
        with self.writer.store.read() as connection:
            return connection.execute(query.limit(1)).first() is not None

    def require_changeable(self, recording_id: int) -> None:
        """Refuses where objects of the rig stand still in the present world; says what to do."""
        with self.writer.store.read() as connection:
            require_nothing_still(connection, recording_id)

    def keep(self, recording_id: int, poses: Sequence[FramePose], author: str) -> Receipt:
        """Sets the poses of a rig, in the place of those before; none = those of the recording's files."""
        with self.writer.store.write() as connection:
            first = select(frames.c.id, frames.c.revision).where(frames.c.recording_id == recording_id)
            frame = connection.execute(first.order_by(frames.c.position.nulls_last(), frames.c.id).limit(1)).first()
            if frame is None:
                raise ProjectError(f"recording {recording_id} has no frames; nothing was changed")
            name = connection.execute(select(recordings.c.name).where(recordings.c.id == recording_id)).scalar_one()
            context = WriteContext(frame.revision, author, effort_target=f"estimate the poses of {name}")
            where = require_writable(connection, frame.id, context)
            write = Write(self.writer.store, connection, frame.id, where, context, new_action())
            present = connection.execute(select(estimates.c.recording_id).where(of_same_rig(recording_id))).scalars()
            for other in present.all():
                write.put("estimates", other, None)
            if poses:
                row = {"recording_id": recording_id, "poses": FRAME_POSES.dump_json(tuple(poses)).decode()}
                write.put("estimates", recording_id, row)
            write.event(KIND)
            return write.finish()
