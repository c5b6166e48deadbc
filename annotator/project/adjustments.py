"""Setting the up direction of a recording, the correction of its calibration, and its estimated poses.

Estimated poses are a row for each rig, audited and undone as any other. Its JSON needs 140 bytes a frame, and 44 packed
in the audit. Where the clouds lie follows from it (`recordings.place_in_world`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from sqlalchemy import Connection, bindparam, func, select, update

from annotator.project.adjusting import Adjustment, adjustment_in, adjustment_row, moving, unit_up
from annotator.project.audit.events import Effort, read_events
from annotator.project.audit.writing import Receipt, Write, WriteContext
from annotator.project.database.schema import adjustments, estimates, events, frames, recordings
from annotator.project.log import Writer, new_action, require_writable
from annotator.project.recordings import ADJUSTED, of_same_rig, require_nothing_still
from annotator.project.records import FRAME_POSES, FramePose, parsed
from annotator.types import Correction
from annotator.types.errors import ProjectError, StaleRevisionError

KIND, ESTIMATED = "recording_adjusted", "poses_estimated"


@dataclass(frozen=True)
class Basis:
    """What a change is based on.

    Attributes:
        adjusted: the recording's `adjusted` when the change was made; None = the present one.
        frame_id: the frame on screen; None = the recording's first one.
    """

    adjusted: int | None = None
    frame_id: int | None = None
    effort: Effort | None = None


NO_BASIS = Basis()


@dataclass(frozen=True, eq=False)
class Adjustments:
    """Adjusts recordings. Each change is an event and an action, which undo reverts."""

    writer: Writer

    def newest(self, recording_id: int) -> int:
        """Id of the event that adjusted a recording last; 0 if none did."""
        with self.writer.store.read() as connection:
            return _newest(connection, recording_id)

    def since(self, event_id: int) -> tuple[tuple[int, int, str], ...]:
        """Recordings that were adjusted after an event: id, id of the latest such event, and its author."""
        query = select(adjustments.c.recording_id, adjustments.c.event_id, events.c.author)
        query = query.join(events, events.c.id == adjustments.c.event_id).where(adjustments.c.event_id > event_id)
        with self.writer.store.read() as connection:
            return tuple((row[0], row[1], row[2]) for row in connection.execute(query.order_by(adjustments.c.event_id)))

    def corrected(self) -> frozenset[int]:
        """Recordings whose calibration is, or once was, corrected: their views may have been drawn of other clouds."""
        with self.writer.store.read() as connection:
            made = read_events(connection, select(events).where(events.c.kind == KIND))
            changed = {(int(row.key), (row.after or {}).get("correction")) for event in made for row in event.rows}
        return frozenset(id for id, correction in changed if correction and moving(correction) is not None)

    def set_up(
        self, recording_id: int, up: Sequence[float] | np.ndarray | None, author: str, basis: Basis = NO_BASIS
    ) -> Receipt:
        """Sets the up direction: a vector in the camera frame (3,) of any length; None = as the files give it."""
        unit = None if up is None else unit_up(up)
        return self._set(recording_id, author, lambda present: Adjustment(unit, present.correction), basis, "set up")

    def correct(self, recording_id: int, correction: Correction, author: str, basis: Basis = NO_BASIS) -> Receipt:
        """Corrects the calibration. Boxes, views and a set up direction stay where they are in the clouds."""
        return self._set(
            recording_id, author, lambda present: present.corrected(correction), basis, "correct the calibration"
        )

    def _set(
        self,
        recording_id: int,
        author: str,
        change: Callable[[Adjustment], Adjustment],
        basis: Basis,
        what: str,
    ) -> Receipt:
        with self.writer.store.write() as connection:
            present = _newest(connection, recording_id)
            if basis.adjusted is not None and basis.adjusted != present:
                raise StaleRevisionError(f"the calibration of recording {recording_id}", basis.adjusted, present)
            of_recording = frames.c.recording_id == recording_id
            if basis.frame_id is not None:
                of_recording &= frames.c.id == basis.frame_id
            first = select(frames.c.id, frames.c.revision).where(of_recording)
            frame = connection.execute(first.order_by(frames.c.position.nulls_last(), frames.c.id).limit(1)).first()
            if frame is None:
                raise ProjectError(f"recording {recording_id} has no such frame; nothing was changed")
            before, _ = adjustment_in(connection.execute(ADJUSTED, {"recording": recording_id}).one())
            row = adjustment_row(recording_id, change(before))
            name = connection.execute(select(recordings.c.name).where(recordings.c.id == recording_id)).scalar_one()
            context = WriteContext(frame.revision, author, effort=basis.effort, effort_target=f"{what} of {name}")
            where = require_writable(connection, frame.id, context)
            write = Write(self.writer.store, connection, frame.id, where, context, new_action())
            write.put("adjustments", recording_id, row)
            write.event(KIND)
            receipt = write.finish()
            make_stale(connection, recording_id, frame.id)
            return receipt


def make_stale(connection: Connection, recording_id: int, frame_id: int) -> None:
    """Gives the other moments of a recording a new revision: changes based on the earlier geometry are refused."""
    others = select(_OTHER.c.moment_id).where(_OTHER.c.recording_id == recording_id, _OTHER.c.id != frame_id)
    newer = update(frames).where(frames.c.moment_id.in_(others)).values(revision=frames.c.revision + 1)
    connection.execute(newer)


_OTHER = frames.alias()
# Built once, since building this frequent query takes longer than running it.
_NEWEST = select(adjustments.c.event_id).where(adjustments.c.recording_id == bindparam("recording"))


def _newest(connection: Connection, recording_id: int) -> int:
    return connection.execute(_NEWEST, {"recording": recording_id}).scalar() or 0


# --- estimated poses --------------------------------------------------------------------------------------------------


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
            query = select(estimates.c.recording_id).where(of_same_rig(recording_id))
            present = connection.execute(query).scalars().all()
            if not (poses or present):
                raise ProjectError(f"the poses of {name} are not estimated; nothing was changed")
            what = f"{'estimate' if poses else 'drop the estimate of'} the poses of {name}"
            context = WriteContext(frame.revision, author, effort_target=what)
            where = require_writable(connection, frame.id, context)
            write = Write(self.writer.store, connection, frame.id, where, context, new_action())
            for other in present:
                write.put("estimates", other, None)
            if poses:
                row = {"recording_id": recording_id, "poses": FRAME_POSES.dump_json(tuple(poses)).decode()}
                write.put("estimates", recording_id, row)
            write.event(ESTIMATED)
            return write.finish()
