"""Registry of a project's recordings and their frames."""

from __future__ import annotations

import json
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import chain, count
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform
from sqlalchemy import ColumnElement, Connection, ScalarSelect, bindparam, func, insert, select, text, update

from annotator.project.adjusting import adjustment_in, unit_up
from annotator.project.audit.events import hide_removed
from annotator.project.database.schema import ALL_LABELS, AnyRow, adjustments, estimates, frames, recordings, stills
from annotator.project.database.store import Store
from annotator.project.records import FRAME_POSES, parsed
from annotator.text import is_within
from annotator.types import NO_CORRECTION, Correction, ReviewState
from annotator.types.errors import HistoryError, NotFoundError, ProjectError, RecordingError
from annotator.types.messages import alternatives, amount, first_few

# --- removed recordings -----------------------------------------------------------------------------------------------
# A removed recording keeps its row, its frames (without an index), their events, and all labels and boxes, which are
# hidden: nothing that reads the views of the tables needs to know of it.

REMOVED = select(recordings.c.id).where(recordings.c.removed_ns.is_not(None))
"""Ids of the removed recordings."""

KEPT = frames.c.recording_id.not_in(REMOVED)
"""Of frames: their recording is in the project."""


def removed_recordings(connection: Connection) -> frozenset[int]:
    """Ids of the removed recordings."""
    return frozenset(connection.execute(REMOVED).scalars())


# --- rigs -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SharedCloud:
    """The cloud of a frame that other cameras of a rig may share.

    Attributes:
        name: the same in all recordings of the rig.
        T_cloud_camera: the camera's pose, without corrections, in a frame that is the same for all of its cameras.
    """

    name: str
    T_cloud_camera: RigidTransform


Poses = Mapping[str, RigidTransform]
NO_CLOUDS: Mapping[str, SharedCloud] = MappingProxyType({})
_OF_RIG, _OWN = recordings.alias(), frames.alias()


def of_rig(recording: int | ScalarSelect[int]) -> ColumnElement[bool]:
    """Of frames: their recording has the same rig as this one."""
    rig = select(_OF_RIG.c.rig_id).where(_OF_RIG.c.id == recording).scalar_subquery()
    return frames.c.recording_id.in_(select(recordings.c.id).where(recordings.c.rig_id == rig))


# --- the registry -----------------------------------------------------------------------------------------------------

# Of recordings: not removed.
_THERE = recordings.c.removed_ns.is_(None)


@dataclass(frozen=True)
class StoredRecording:
    """A recording of the project.

    Attributes:
        up: unit vector against gravity in the camera frame, if known and constant over the recording.
        options: how its reader reads it, as JSON; "" = as the reader decides.
        correction: of its calibration; `up` is in the corrected camera frame.
        adjusted: id of the event that set `up` and `correction`; 0 = as the recording was added.
        fingerprint: of a frame's content, as it was given when the recording was added; None = not known.
        removed_by: who has removed it from the project; None = nobody.
        rig_id: the same for the cameras of a rig, which share moments and tracks.
    """

    id: int
    path: Path
    format: str
    name: str
    is_sequence: bool
    up: tuple[float, float, float] | None
    added_ns: int
    frames: int
    options: str = ""
    correction: Correction = NO_CORRECTION
    adjusted: int = 0
    fingerprint: str | None = None
    removed_by: str | None = None
    rig_id: int = 0


@dataclass(frozen=True)
class Rescan:
    """Result of scanning a recording again: new frame keys, and missing ones (their labels stay)."""

    added: tuple[str, ...]
    missing: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Recordings:
    """Registers recordings; never changes their files.

    Attributes:
        readable: folders in which recordings may lie; None = anywhere. A project that somebody sent may name any path.
    """

    store: Store
    readable: tuple[Path, ...] | None = None

    def add(
        self,
        path: Path,
        format: str,
        name: str,
        keys: Sequence[str],
        is_sequence: bool,
        up: Sequence[float | int] | np.ndarray | None = None,
        options: str = "",
        fingerprint: str | None = None,
        left_out: Collection[str] = (),
        clouds: Mapping[str, SharedCloud] = NO_CLOUDS,
        poses: Poses | None = None,
    ) -> StoredRecording:
        """Registers a recording and its frames, at revision 0.

        Args:
            name: "-2", "-3" ... is appended if another recording has this name.
            up: vector against gravity in the camera frame (3,), any length.
            left_out: keys of frames that get no index, as if a scan had not found them.
            clouds: by key, of a camera of a rig.
            poses: by key, `T_world_camera`, without corrections; None = they stay as they are stored.
        """
        path = path.resolve()
        _require_unique(path, keys)
        with self.store.write() as connection:
            same = (recordings.c.path == str(path), recordings.c.options == options)
            if (there := connection.execute(select(recordings.c.removed_ns).where(*same)).first()) is not None:
                if there.removed_ns is not None:
                    raise ProjectError(f"{path} was removed from the project; `annotator add` brings it back")
                raise ProjectError(f"{path} is in the project already; scan it again to find new frames")
            number = 1 + (connection.execute(select(func.max(recordings.c.id))).scalar() or 0)
            row = {
                "id": number,
                "path": str(path),
                "format": format,
                "name": _free_name(connection, name),
                "is_sequence": is_sequence,
                "up": None if up is None else json.dumps(unit_up(up)),
                "added_ns": self.store.clock(),
                "options": options,
                "fingerprint": fingerprint,
                "rig_id": _rig(connection, path, options) if clouds else None,
            }
            row["rig_id"] = row["rig_id"] or number
            connection.execute(insert(recordings), row)
            _update_frames(connection, number, {}, _indices(keys, left_out), clouds, poses)
            return _recording(connection, number)

    def rescan(
        self,
        recording_id: int,
        keys: Sequence[str],
        fingerprint: str | None = None,
        left_out: Collection[str] = (),
        clouds: Mapping[str, SharedCloud] = NO_CLOUDS,
        poses: Poses | None = None,
    ) -> Rescan:
        """Updates a recording's frames: new ones are added; missing ones stay, without an index.

        A removed recording comes back with its labels.

        Args:
            fingerprint: as in `StoredRecording`; kept if none is known yet.
        """
        with self.store.write() as connection:
            before = _recording(connection, recording_id, removed=True)
            _require_unique(before.path, keys)
            known = _positions(connection, recording_id)
            new = _update_frames(connection, recording_id, known, _indices(keys, left_out), clouds, poses)
            if before.fingerprint is None and fingerprint is not None:
                same = recordings.c.id == recording_id
                connection.execute(update(recordings).where(same).values(fingerprint=fingerprint))
            _bring_back(connection, before)
        present = set(keys)
        return Rescan(new, tuple(key for key in known if key not in present))

    def move(
        self,
        moved: Mapping[int, tuple[Path, Sequence[str]]],
        clouds: Mapping[int, Mapping[str, SharedCloud]] = MappingProxyType({}),
        poses: Mapping[int, Poses] = MappingProxyType({}),
    ) -> tuple[StoredRecording, ...]:
        """Changes the paths of moved recordings, all or none; their frames, labels and boxes stay as they are.

        Those that were removed come back.

        Args:
            moved: by recording id, the new path, stored as an absolute path, and the keys of the frames there: all
                those of the latest scan, and possibly new ones.
            clouds, poses: by recording id, as for `add`.
        """
        with self.store.write() as connection:
            for recording_id, (path, keys) in moved.items():
                of_clouds = clouds.get(recording_id, NO_CLOUDS)
                _move(connection, recording_id, path.resolve(), keys, of_clouds, poses.get(recording_id))
            return tuple(_recording(connection, recording_id) for recording_id in moved)

    def remove(self, recording_id: int, author: str) -> None:
        """Takes a recording out of the project; its labels stay in the log, and come back with it."""
        with self.store.write() as connection:
            _recording(connection, recording_id)
            values = {"removed_ns": self.store.clock(), "removed_by": author}
            connection.execute(update(recordings).where(recordings.c.id == recording_id).values(values))
            connection.execute(update(frames).where(frames.c.recording_id == recording_id).values(position=None))
            hide_removed(connection)

    def removed(self) -> tuple[StoredRecording, ...]:
        """The recordings that were removed, in the order they were added."""
        return self._those(recordings.c.removed_ns.is_not(None))

    def removed_by(self) -> dict[int, str | None]:
        """All recordings by id: who has removed it from the project; None = nobody."""
        with self.store.read() as connection:
            return {
                row.id: row.removed_by for row in connection.execute(select(recordings.c.id, recordings.c.removed_by))
            }

    def label_counts(self, states: Collection[ReviewState] = tuple(ReviewState)) -> dict[int, int]:
        """Numbers of labels with one of these states by recording id, also of removed recordings."""
        stored = select(frames.c.recording_id, func.count()).join(ALL_LABELS, ALL_LABELS.c.frame_id == frames.c.id)
        stored = stored.where(ALL_LABELS.c.behind.is_(None), ALL_LABELS.c.state.in_([each.value for each in states]))
        with self.store.read() as connection:
            return {row[0]: row[1] for row in connection.execute(stored.group_by(frames.c.recording_id))}

    def used_keys(self, recording_id: int) -> frozenset[str]:
        """Keys of the frames, also of a removed recording, that the latest scan has found or that have events."""
        with self.store.read() as connection:
            return frozenset(_used_keys(connection, recording_id))

    def all(self) -> tuple[StoredRecording, ...]:
        """All recordings, in the order they were added."""
        return self._those(_THERE)

    def get(self, recording_id: int, *, removed: bool = False) -> StoredRecording:
        """One recording; with `removed`, also one that was removed."""
        with self.store.read() as connection:
            return _recording(connection, recording_id, removed=removed)

    def require_readable(self, recording: StoredRecording) -> None:
        """Checks the place of a recording before it is opened."""
        if self.readable is not None and not any(is_within(folder, recording.path) for folder in self.readable):
            raise RecordingError(
                f"recording {recording.name} lies outside the folders that this server offers to other computers; "
                "whoever runs it can offer its folder with --folder"
            )

    def at(self, path: Path) -> tuple[StoredRecording, ...]:
        """The recordings of a path, which differ in their options, in the order of their addition."""
        return self._those(_THERE, recordings.c.path == str(path))

    def _those(self, *are: ColumnElement[bool]) -> tuple[StoredRecording, ...]:
        with self.store.read() as connection:
            return tuple(map(_stored, connection.execute(_query().where(*are).order_by(recordings.c.id))))

    def find(self, name: str, *, removed: bool = False) -> StoredRecording:
        """The recording of that name; with `removed`, also one that was removed."""
        stored, gone = self.all(), self.removed()
        for recording in (*stored, *(gone if removed else ())):
            if recording.name == name:
                return recording
        if name in {recording.name for recording in gone}:
            raise NotFoundError(f"recording {name!r} was removed from the project; `annotator add` brings it back")
        names = [recording.name for recording in stored]
        raise NotFoundError(f"the project has no recording {name!r}; {alternatives(name, names)}")


def _query() -> Any:
    present = (
        select(func.count())
        .where(frames.c.recording_id == recordings.c.id, frames.c.position.is_not(None))
        .scalar_subquery()
    )
    adjusted = (
        adjustments.c.up.label("adjusted_up"),
        adjustments.c.correction,
        adjustments.c.event_id.label("adjusted"),
    )
    return select(recordings, present.label("frames"), *adjusted).outerjoin(adjustments)


# The adjustment of a recording, for `adjustment_in`; built once, since building a query takes longer than running it.
ADJUSTED = (
    select(
        recordings.c.up,
        adjustments.c.up.label("adjusted_up"),
        adjustments.c.correction,
        adjustments.c.event_id.label("adjusted"),
    )
    .outerjoin(adjustments)
    .where(recordings.c.id == bindparam("recording"))
)


def _move(
    connection: Connection,
    recording_id: int,
    path: Path,
    keys: Sequence[str],
    clouds: Mapping[str, SharedCloud],
    poses: Poses | None,
) -> None:
    _require_unique(path, keys)
    before = _recording(connection, recording_id, removed=True)
    taken = select(recordings.c.id, recordings.c.name, recordings.c.removed_ns).where(
        recordings.c.path == str(path),
        recordings.c.options == before.options,
        recordings.c.id != recording_id,
    )
    other = connection.execute(taken).first()
    if other is not None and other.removed_ns is None:
        raise ProjectError(
            f"{path} is in the project already, as recording {other.name}; to have the labels of {before.name} "
            f"there, first run `annotator project remove PROJECT {shlex.quote(other.name)}`"
        )
    if other is not None:  # a removed one gives its place up; `project move` can still bring it back
        same = recordings.c.id == other.id
        connection.execute(update(recordings).where(same).values(path=f"{path}.removed-{other.id}"))
    known = _positions(connection, recording_id)
    # a removed one has no latest scan
    needed = known if before.removed_by is None else dict.fromkeys(_used_keys(connection, recording_id), 0)
    _require_same(before, path, needed, keys)
    _update_frames(connection, recording_id, known, _indices(keys), clouds, poses)
    if path != before.path:
        same = recordings.c.id == recording_id
        connection.execute(update(recordings).where(same).values(path=str(path)))
    _bring_back(connection, before)


def _bring_back(connection: Connection, before: StoredRecording) -> None:
    """Puts a removed recording back into the project, with its labels and boxes."""
    if before.removed_by is not None:
        back = {"removed_ns": None, "removed_by": None}
        connection.execute(update(recordings).where(recordings.c.id == before.id).values(back))
        hide_removed(connection)


def _recording(connection: Connection, recording_id: int, *, removed: bool = False) -> StoredRecording:
    """A recording; with `removed`, also one that was removed."""
    row = connection.execute(_query().where(recordings.c.id == recording_id)).first()
    if row is None or (row.removed_ns is not None and not removed):
        raise NotFoundError(f"the project has no recording with id {recording_id}")
    return _stored(row)


def _used_keys(connection: Connection, recording_id: int) -> Sequence[str]:
    used = frames.c.position.is_not(None) | (frames.c.revision > 0)
    query = select(frames.c.key).where(frames.c.recording_id == recording_id, used).order_by(frames.c.id)
    return connection.execute(query).scalars().all()


def _positions(connection: Connection, recording_id: int) -> dict[str, int | None]:
    """Frame key -> index of all frames of a recording."""
    query = select(frames.c.key, frames.c.position).where(frames.c.recording_id == recording_id)
    return {row.key: row.position for row in connection.execute(query)}


def _stored(row: AnyRow) -> StoredRecording:
    set_, event_id = adjustment_in(row)
    columns: dict[str, Any] = {each.name: getattr(row, each.name, None) for each in fields(StoredRecording)}
    made = {"path": Path(row.path), "up": set_.up, "correction": set_.correction, "adjusted": event_id}
    return StoredRecording(**columns | made)


def _require_unique(path: Path, keys: Sequence[str]) -> None:
    if len(set(keys)) < len(keys):
        repeated = next(key for key in keys if keys.count(key) > 1)
        raise ProjectError(f"{path}: frame key {repeated!r} occurs twice; keys must be unique within a recording")


def _require_same(recording: StoredRecording, path: Path, known: Mapping[str, int | None], keys: Sequence[str]) -> None:
    present = set(keys)
    missing = [key for key, position in known.items() if position is not None and key not in present]
    if not missing:
        return
    unknown = [key for key in keys if key not in known]
    also = f" and also has {_frame_list(unknown)}" if unknown else ""
    raise ProjectError(
        f"{path} is not {recording.name}: it lacks {_frame_list(missing)}{also}; nothing was changed; "
        f"give the folder with the same {amount(recording.frames, 'frame')}"
    )


def _frame_list(keys: Sequence[str]) -> str:
    return f"{'frame' if len(keys) == 1 else 'frames'} {first_few(keys, 5)}"


def _free_name(connection: Connection, name: str) -> str:
    taken = set(connection.execute(select(recordings.c.name)).scalars())
    return next(free for free in chain([name], (f"{name}-{number}" for number in count(2))) if free not in taken)


def _indices(keys: Sequence[str], left_out: Collection[str] = ()) -> dict[str, int | None]:
    """Frame key -> index; None for those that are left out."""
    return {key: None if key in left_out else index for index, key in enumerate(keys)}


def _rig(connection: Connection, path: Path, options: str) -> int | None:
    """The rig of the recordings of a path whose options differ from these only in the camera."""

    def others(text: str) -> dict[str, Any]:
        return {name: value for name, value in json.loads(text or "{}").items() if name != "camera"}

    beside = select(recordings.c.rig_id, recordings.c.options).where(recordings.c.path == str(path))
    found = connection.execute(beside.order_by(recordings.c.id)).all()
    return next((row.rig_id for row in found if others(row.options) == others(options)), None)


def _update_frames(
    connection: Connection,
    recording_id: int,
    known: dict[str, int | None],
    present: dict[str, int | None],
    clouds: Mapping[str, SharedCloud] = NO_CLOUDS,
    poses: Poses | None = None,
) -> tuple[str, ...]:
    """Updates the index of all frames and inserts new ones; returns the keys of the new frames."""
    moved = [
        {"of_recording": recording_id, "of_key": key, "new_position": present.get(key)}
        for key, position in known.items()
        if present.get(key) != position
    ]
    if moved:
        same = (frames.c.recording_id == bindparam("of_recording")) & (frames.c.key == bindparam("of_key"))
        connection.execute(update(frames).where(same).values(position=bindparam("new_position")), moved)
    moments = _moments(connection, recording_id) if clouds else {}

    def at_cloud(number: int, key: str) -> dict[str, Any]:
        """The columns that say where a frame without changes belongs."""
        if (cloud := clouds.get(key)) is None:
            return {"moment_id": number, "revision": 0, "cloud": None, "pose": None}
        moment, revision = moments.pop(cloud.name, (number, 0))
        pose = json.dumps(cloud.T_cloud_camera.as_matrix().tolist())
        return {"moment_id": moment, "revision": revision, "cloud": cloud.name, "pose": pose}

    # those that lacked a pose in the latest scan
    alone = (frames.c.recording_id == recording_id) & frames.c.cloud.is_(None) & (frames.c.revision == 0)
    for number, key in connection.execute(select(frames.c.id, frames.c.key).where(alone)).all() if clouds else ():
        connection.execute(update(frames).where(frames.c.id == number).values(at_cloud(number, key)))
    first = 1 + (connection.execute(select(func.max(frames.c.id))).scalar() or 0)
    new = [
        {"id": number, "recording_id": recording_id, "key": key, "position": present[key], "finalised": False}
        | at_cloud(number, key)
        for number, key in enumerate((key for key in present if key not in known), first)
    ]
    if new:
        connection.execute(insert(frames), new)
    if poses is not None:
        _set_recorded(connection, recording_id, poses)
    return tuple(str(row["key"]) for row in new)


def _set_recorded(connection: Connection, recording_id: int, poses: Poses) -> None:
    """Sets where the clouds are in the world, as the recording says it."""
    query = select(frames.c.id, frames.c.key, frames.c.pose, frames.c.recorded_world)
    changed = list[dict[str, Any]]()
    for row in connection.execute(query.where(frames.c.recording_id == recording_id)).all():
        if (world := _world(poses.get(row.key), row.pose)) != row.recorded_world:
            changed.append({"of_frame": row.id, "new_world": world})
    if changed:
        of_frame = frames.c.id == bindparam("of_frame")
        connection.execute(update(frames).where(of_frame).values(recorded_world=bindparam("new_world")), changed)
    place_in_world(connection, recording_id)


def _world(T_world_camera: RigidTransform | None, T_cloud_camera: str | None) -> str | None:
    if T_world_camera is not None and T_cloud_camera is not None:
        T_world_camera = T_world_camera * RigidTransform.from_matrix(json.loads(T_cloud_camera)).inv()
    return None if T_world_camera is None else json.dumps(T_world_camera.as_matrix().tolist())


def place_in_world(connection: Connection, recording_id: int) -> bool:
    """Sets where the clouds of a rig are in the world: as was estimated, else as its recordings say it.

    Where that changes, still objects are looked for again. Returns whether any has changed.
    """
    of_frames = select(frames.c.id, frames.c.key, frames.c.recording_id, frames.c.moment_id, frames.c.pose)
    of_frames = of_frames.add_columns(frames.c.world, frames.c.recorded_world)
    rows = connection.execute(of_frames.where(of_rig(recording_id))).all()
    worlds: dict[int, str | None] = {row.id: row.recorded_world for row in rows}
    if found := estimated_poses(connection, recording_id):
        worlds = dict.fromkeys(worlds)
        for row in rows:
            if row.recording_id == found[0] and (T := found[1].get(row.key)) is not None:
                worlds[row.moment_id] = _world(T, row.pose)
    changed = [{"of_frame": row.id, "new_world": worlds[row.id]} for row in rows if worlds[row.id] != row.world]
    if changed:
        of_frame = frames.c.id == bindparam("of_frame")
        connection.execute(update(frames).where(of_frame).values(world=bindparam("new_world")), changed)
        # what an operator has seen there stays
        again = (
            "place = iif(place IS NULL AND :new_world IS NOT NULL, NULL, ''), seen = seen AND :new_world IS NOT NULL"
        )
        connection.execute(text(f"UPDATE sightings SET {again} WHERE moment_id = :of_frame"), changed)
    return bool(changed)


def of_same_rig(recording_id: int) -> ColumnElement[bool]:
    """Of estimates: their recording has the same rig as this one."""
    rig = select(_OF_RIG.c.rig_id).where(_OF_RIG.c.id == recording_id).scalar_subquery()
    return estimates.c.recording_id.in_(select(recordings.c.id).where(recordings.c.rig_id == rig))


def estimated_poses(connection: Connection, recording_id: int) -> tuple[int, dict[str, RigidTransform]] | None:
    """The recording of a rig whose poses were estimated, and its `T_world_camera` by key, without corrections."""
    row = connection.execute(select(estimates).where(of_same_rig(recording_id))).first()
    if row is None:
        return None
    found = parsed(FRAME_POSES.validate_json, row.poses)
    return row.recording_id, {each.key: each.transform() for each in found if each.pose is not None}


def require_nothing_still(connection: Connection, recording_id: int) -> None:
    """Refuses to change the world in which objects of a rig stand still."""
    rig = select(recordings.c.rig_id).where(recordings.c.id == recording_id).scalar_subquery()
    is_there = stills.c.state != ReviewState.REJECTED.value
    tracks = connection.execute(select(stills.c.track_id).where(stills.c.rig_id == rig, is_there)).scalars().all()
    if tracks:
        raise HistoryError(
            f"{amount(len(tracks), 'track')} of it stand still in this world: {first_few(list(map(str, tracks)), 5)}; "
            "first say that they move (`annotator tracks moving`), or undo what has made them"
        )


def _moments(connection: Connection, recording_id: int) -> dict[str, tuple[int, int]]:
    """The moments of a rig that a recording has no frame of, each with its revision, by the name of the cloud."""
    own = select(_OWN.c.moment_id).where(_OWN.c.recording_id == recording_id)
    shared = select(frames.c.cloud, frames.c.moment_id, frames.c.revision).where(frames.c.cloud.is_not(None))
    rows = connection.execute(shared.where(of_rig(recording_id), frames.c.moment_id.not_in(own)))
    return {row.cloud: (row.moment_id, row.revision) for row in rows}
