"""Objects that stand still: each has one box, in the world of its rig, and is seen in many moments.

A change of any of its labels, which the store takes as one of all (`changes.py`), writes one row. Which moments see it
follows from the recordings: it is looked for (`workflows/tracks/still_objects.py`), and kept here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Sequence
from dataclasses import astuple, dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform
from sqlalchemy import Connection, delete, func, select

from annotator.project.audit.writing import Receipt
from annotator.project.database.schema import frames, recordings, sightings, stills
from annotator.project.database.store import driver_of
from annotator.project.frames import FRAME_COLUMNS, StoredFrame
from annotator.project.log import FramePart, Writer, new_action
from annotator.project.recordings import of_rig
from annotator.project.rows import Terms, camera_world, world_box
from annotator.types import OrientedBox, ReviewState

_MOMENTS = frames.alias()


@dataclass(frozen=True, eq=False)
class StillObject:
    """A track that stands still.

    Attributes:
        box: in the frame of the world.
        is_open: whether it is a proposal that a pass replaces.
        place: where about the box is; what was looked for there is looked for again once this changes.
    """

    uid: str
    track_id: int
    label: str
    state: ReviewState
    box: OrientedBox
    is_open: bool = False

    @property
    def place(self) -> str:
        """Centre, size and rotation, in steps of half to a quarter of the shortest side, and of 0.3 (17 degrees)."""
        step_m = 2.0 ** math.floor(math.log2(self.box.size_m.min() / 2))
        lengths = [*self.box.center_m, *self.box.size_m]
        steps = [round(x / step_m) for x in lengths] + [round(x / 0.3) for x in self.box.rotation.ravel()]
        return json.dumps([step_m, *steps], separators=(",", ":"))


@dataclass(frozen=True)
class Sighting:
    """What a moment sees of a still object.

    Attributes:
        still: its uid.
        frame_id: of the camera that sees it.
        points, hidden_share: points in its box; of those in its outline, the share before it.
        place: the object's `place`; None = an operator has had a box of it there.
    """

    still: str
    frame_id: int
    moment_id: int
    is_seen: bool
    points: int | None = None
    hidden_share: float | None = None
    place: str | None = None


@dataclass(frozen=True, eq=False)
class Stills:
    """Reads and keeps still objects, and the moments that see them."""

    writer: Writer

    def of(self, recording_id: int) -> tuple[StillObject, ...]:
        """The still objects of a recording's rig, in the order of their tracks."""
        rig = select(recordings.c.rig_id).where(recordings.c.id == recording_id).scalar_subquery()
        with self.writer.store.read() as connection:
            names = Terms(connection).names
            found = connection.execute(select(stills).where(stills.c.rig_id == rig).order_by(stills.c.track_id))
            return tuple(
                StillObject(
                    row.uid,
                    row.track_id,
                    names[row.class_id],
                    ReviewState(row.state),
                    world_box(row.box),
                    row.state == ReviewState.PROPOSED.value and not row.values_set,
                )
                for row in found
            )

    def versions(self) -> dict[int, tuple[int, int]]:
        """For each rig with still objects, what differs once one of them has changed, come or gone."""
        version = func.count(), func.sum(stills.c.event_id)
        with self.writer.store.read() as connection:
            rows = connection.execute(select(stills.c.rig_id, *version).group_by(stills.c.rig_id))
            return {rig: (number, events) for rig, number, events in rows}

    def poses(self, recording_id: int) -> dict[int, RigidTransform]:
        """`T_camera_world` of a recording's frames, by id, with the correction; without those that are not known."""
        matrices = self.pose_matrices(recording_id)
        # they are rotations already, and to check that takes four times as long
        return {id: RigidTransform(matrix, normalize=False) for id, matrix in matrices.items()}

    def pose_matrices(
        self, recording_id: int, among: Collection[int] | None = None
    ) -> dict[int, Float64[np.ndarray, "4 4"]]:
        """As `poses`, at a tenth of its time; `among`: ids of frames, None = all."""
        query = select(frames.c.id).join(_MOMENTS, _MOMENTS.c.id == frames.c.moment_id)
        known = query.where(frames.c.recording_id == recording_id, _MOMENTS.c.world.is_not(None))
        known = known if among is None else known.where(frames.c.id.in_(among))
        with self.writer.store.read() as connection:
            terms = Terms(connection)
            return {id: camera_world(terms.place(id, in_world=True)) for id in connection.execute(known).scalars()}

    def unsighted(self, recording_id: int) -> dict[StoredFrame, list[StillObject]]:
        """The frames of a recording's rig whose moments have not been looked at for some still objects, and these."""
        objects = [each for each in self.of(recording_id) if each.state is not ReviewState.REJECTED]
        if not objects:
            return {}
        query = select(*FRAME_COLUMNS).join(_MOMENTS, _MOMENTS.c.id == frames.c.moment_id)
        present = (of_rig(recording_id), frames.c.position.is_not(None), _MOMENTS.c.world.is_not(None))
        columns = sightings.c.still, sightings.c.moment_id, sightings.c.place
        known = select(*columns).where(sightings.c.still.in_([each.uid for each in objects]))
        places = {each.uid: each.place for each in objects}
        with self.writer.store.read() as connection:
            done = {(s, m) for s, m, place in connection.execute(known) if place in (None, places[s])}
            ordered = query.where(*present).order_by(frames.c.position, frames.c.id)
            every = [StoredFrame(*row) for row in connection.execute(ordered)]
        left = {each: [one for one in objects if (one.uid, each.moment_id) not in done] for each in every}
        return {frame: ones for frame, ones in left.items() if ones}

    def keep(self, found: Sequence[Sighting]) -> None:
        """Keeps what moments see, in the place of what they saw before."""
        with self.writer.store.write() as connection:
            _keep(connection, found)

    def forget(self) -> None:
        """Forgets what moments see of objects that are gone. If an undo brings one back, that is looked for again."""
        is_gone = sightings.c.still.not_in(select(stills.c.uid)) & sightings.c.place.is_not(None)
        with self.writer.store.write() as connection:
            connection.execute(delete(sightings).where(is_gone))

    def change(
        self, parts: Sequence[FramePart], seen: Sequence[Sighting] = (), action: str | None = None
    ) -> tuple[Receipt, ...]:
        """Changes several frames as one action, all or nothing, and keeps sightings with them."""
        action = action or new_action()
        with self.writer.store.write() as connection:
            of_parts = ((each.frame_id, each.payloads, each.context) for each in parts)
            receipts = tuple(self.writer.to_frame_in(connection, *each, action) for each in of_parts)
            _keep(connection, seen)
        return receipts


# What an operator has had a box of is seen, whatever the clouds say.
_KEEP = """
INSERT INTO sightings (uid, still, frame_id, moment_id, seen, points, hidden_share, place)
VALUES (?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT (uid) DO UPDATE SET frame_id = excluded.frame_id, seen = excluded.seen,
points = excluded.points, hidden_share = excluded.hidden_share, place = excluded.place WHERE place IS NOT NULL
"""


def _keep(connection: Connection, found: Sequence[Sighting]) -> None:
    rows = [(f"{each.still}_{each.moment_id}", *astuple(each)) for each in found]
    driver_of(connection).executemany(_KEEP, rows)
