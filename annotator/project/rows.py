"""Columns of the tables as values, and back: classes by their names, boxes in the frame of the camera."""

from __future__ import annotations

import json
import random
import re
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform
from sqlalchemy import Connection

from annotator.project.adjusting import moved_box, moved_geometry, moving
from annotator.project.classes.attributes import Attribute, ClassStyle
from annotator.project.database.store import driver_of
from annotator.project.records import BOX_2D, BOXES_2D, OWN, BoxRecord, StoredSaid, ViewGeometry, WorldBox, parsed
from annotator.types import Box2D, BoxKind, OrientedBox
from annotator.types.errors import ProjectError
from annotator.types.label import AttributeValue, Said

Row = dict[str, Any]
"""A row of an audited table as SQLite has it: a Boolean is 0 or 1."""

Names = tuple[tuple[int, str], ...]

Place = tuple[str | None, str | None, str | None]
"""Correction and pose of a frame's camera, as they are stored; None = it does not move the boxes of the cloud. And the
pose of the cloud in the world; None = not known, or not needed."""
AT_CAMERA: Place = (None, None, None)
# What only the JSON of a `WorldBox` has.
_IN_WORLD = '"in_world"'


@lru_cache(maxsize=1024)
def T_camera_cloud(place: Place) -> RigidTransform | None:
    """From the frame of the cloud, in which boxes are stored, to that of the camera; None if they are the same."""
    correction, pose, _ = place
    T = None if correction is None else moving(correction)
    if pose is None:
        return T
    T_recorded_cloud = parsed(lambda text: RigidTransform.from_matrix(json.loads(text)), pose).inv()
    return T_recorded_cloud if T is None else T * T_recorded_cloud


@lru_cache(maxsize=8192)
def camera_world(place: Place) -> Float64[np.ndarray, "4 4"]:
    """The matrix of the transform from the frame of the world to that of the camera.

    Plain numpy, since a still object may have labels in thousands of frames, and a `RigidTransform` takes ten times as
    long.

    Raises:
        ProjectError: the moment has no pose.
    """
    if (world := place[2]) is None:
        raise ProjectError("the recording does not say where its camera was at this moment")
    T_world_cloud = parsed(lambda text: np.array(json.loads(text), np.float64).reshape(4, 4), world)
    inverse, turn = np.eye(4), T_world_cloud[:3, :3].T
    inverse[:3, :3], inverse[:3, 3] = turn, -turn @ T_world_cloud[:3, 3]
    T = T_camera_cloud(place)
    return inverse if T is None else T.as_matrix() @ inverse


def T_camera_stored(content: str, place: Place) -> Float64[np.ndarray, "4 4"] | None:
    """From the frame in which a 3D box is stored, the cloud's or the world, to that of the camera; None: the same."""
    if _IN_WORLD in content:
        return camera_world(place)
    T = T_camera_cloud(place)
    return None if T is None else T.as_matrix()


def _style(colour: str | None, key: str | None, still: int | None) -> ClassStyle:
    return ClassStyle(colour=colour, key=key, still=None if still is None else bool(still))


def new_uid() -> str:
    """A uid for a label. It begins with the time, so that the database adds those of an import at one place."""
    return f"{time.time_ns():016x}{random.getrandbits(64):016x}"


_PLACE = """
SELECT frames.recording_id, frames.pose, moments.world
FROM frames JOIN frames AS moments ON moments.id = frames.moment_id WHERE frames.id = ?
"""


_OF_STILL = re.compile(r"([0-9a-f]{32})_[0-9]+")


def still_of(uid: str) -> str | None:
    """The uid of the still object that gives a label; None for a label that has a row."""
    found = _OF_STILL.fullmatch(uid)
    return None if found is None else found[1]


class Terms:
    """The classes and attributes, and where the clouds lie, as of one transaction.

    Attributes:
        names: of all classes that the project has or had, by id; several may have the same.
        ids: by name, first those of the project's classes.
        classes: the names of the project's classes, in order.
        key: the names, for caches.
        has_stills: whether any object stands still.
        of_tracks: the values of tracks that are known, by rig and track.
    """

    def __init__(self, connection: Connection) -> None:
        self._driver = driver_of(connection)
        found = self._driver.execute("SELECT id, name, position FROM classes ORDER BY position, id DESC").fetchall()
        self.names: dict[int, str] = {number: name for number, name, _ in found}
        self.ids = {name: number for number, name, _ in found}
        self.classes = tuple(name for _, name, position in found if position is not None)
        self.key: Names = tuple(self.names.items())
        stored = self._driver.execute("SELECT recording_id, correction FROM adjustments").fetchall()
        self._corrections = {id: correction for id, correction in stored if moving(correction) is not None}
        shared = "SELECT 1 FROM frames WHERE cloud IS NOT NULL LIMIT 1"
        self.has_stills = self._driver.execute("SELECT 1 FROM stills LIMIT 1").fetchone() is not None
        self._are_same = not self._corrections and self._driver.execute(shared).fetchone() is None
        self._of_frames: dict[tuple[int | None, bool], Place] = {}
        self._last_label: int | None = None
        self.of_tracks: dict[tuple[int, int], dict[str, AttributeValue]] = {}

    # --- classes ------------------------------------------------------------------------------------------------------

    @cached_property
    def styles(self) -> dict[str, ClassStyle]:
        """The looks of classes that differ from those by default."""
        query = "SELECT name, colour, shortcut, still FROM classes WHERE coalesce(colour, shortcut, still) IS NOT NULL"
        return parsed(lambda sql: {row[0]: _style(*row[1:]) for row in self._driver.execute(sql)}, query)

    @cached_property
    def attributes(self) -> tuple[Attribute, ...]:
        """The project's attributes, in order."""
        rows = self._driver.execute("SELECT name, content FROM attributes ORDER BY position, name").fetchall()
        return tuple(parsed(partial(self._attribute, name), content) for name, content in rows)

    def _attribute(self, name: str, content: str) -> Attribute:
        fields = json.loads(content)
        of = dict.fromkeys(self.names[int(number)] for number in fields.pop("classes", ()))
        return Attribute(name=name, classes=tuple(of), **fields)

    def attributes_of(self, label: str) -> list[Attribute]:
        """The attributes of a class's boxes and tracks."""
        return [each for each in self.attributes if each.is_of(label)]

    def next_label_id(self) -> int:
        """An id that no label has ever had."""
        if self._last_label is None:
            given = self._driver.execute("SELECT seq FROM sqlite_sequence WHERE name = 'labels'").fetchone()
            self._last_label = 0 if given is None else int(given[0])
        self._last_label += 1
        return self._last_label

    def _coded(self, box: Box2D) -> Box2D:
        return replace(box, label=str(self.ids[box.label]))

    # --- clouds -------------------------------------------------------------------------------------------------------

    def place(self, frame_id: int | None, in_world: bool = False) -> Place:
        """Where a frame's camera is at its cloud, and with still objects (or `in_world`) in the world."""
        in_world |= self.has_stills
        if self._are_same and not in_world:
            return AT_CAMERA
        if (frame_id, in_world) not in self._of_frames:
            found = self._driver.execute(_PLACE, (frame_id,)).fetchone() or (None, None, None)
            place = self._corrections.get(found[0]), found[1], found[2] if in_world else None
            self._of_frames[frame_id, in_world] = place
        return self._of_frames[frame_id, in_world]

    def T_camera_world(self, frame_id: int | None) -> RigidTransform:
        """From the frame of the world to that of a frame's camera."""
        return RigidTransform.from_matrix(camera_world(self.place(frame_id, in_world=True)))

    def T_camera_cloud(self, frame_id: int | None) -> RigidTransform | None:
        """From the frame in which a frame's boxes are stored to that of the camera; None if they are the same."""
        return T_camera_cloud(self.place(frame_id))

    def _T_cloud_camera(self, frame_id: int | None) -> RigidTransform | None:
        T = self.T_camera_cloud(frame_id)
        return None if T is None else T.inv()

    # --- reading ------------------------------------------------------------------------------------------------------

    def box(self, content: str, frame_id: int | None) -> OrientedBox:
        """A 3D box, camera frame."""
        return box_of(content, self.place(frame_id))

    def boxes_2d(self, content: str) -> tuple[Box2D, ...]:
        """2D boxes."""
        return tuple(_named(box, self.key) for box in parsed(BOXES_2D.validate_json, content))

    def geometry(self, content: str | None, frame_id: int | None) -> ViewGeometry | None:
        """The geometry of a pseudo-view."""
        if content is None:
            return None
        geometry, T = parsed(ViewGeometry.model_validate_json, content), self.T_camera_cloud(frame_id)
        if geometry.image_box is not None:
            geometry = geometry.model_copy(update={"image_box": _named(geometry.image_box, self.key)})
        return geometry if T is None else moved_geometry(geometry, T)

    # --- writing; all classes must have ids ---------------------------------------------------------------------------

    def box_json(self, box: BoxRecord, frame_id: int | None) -> str:
        """A 3D box as it is stored."""
        T = self._T_cloud_camera(frame_id)
        return (box if T is None else moved_box(box, T)).model_dump_json()

    def world_json(self, box: BoxRecord, frame_id: int | None) -> str:
        """The 3D box of an object that stands still, as it is stored."""
        return WorldBox.of(box.box().transformed(self.T_camera_world(frame_id).inv())).model_dump_json()

    def box_2d_json(self, box: Box2D | None) -> str | None:
        """A 2D box as it is stored."""
        return None if box is None else BOX_2D.dump_json(self._coded(box), warnings="error").decode()

    def boxes_2d_json(self, boxes: Iterable[Box2D]) -> str:
        """2D boxes as they are stored."""
        return BOXES_2D.dump_json(tuple(map(self._coded, boxes)), warnings="error").decode()

    def geometry_json(self, geometry: ViewGeometry | None, frame_id: int | None) -> str | None:
        """The geometry of a pseudo-view as it is stored."""
        if geometry is None:
            return None
        T = self._T_cloud_camera(frame_id)
        geometry = geometry if T is None else moved_geometry(geometry, T)
        if geometry.image_box is not None:
            geometry = geometry.model_copy(update={"image_box": self._coded(geometry.image_box)})
        return geometry.model_dump_json()


@lru_cache(maxsize=4096)
def box_of(content: str, place: Place) -> OrientedBox:
    """A stored box. A page reads all boxes of its frame again after each change of one."""
    if _IN_WORLD in content:
        box = world_box(content)
        return OrientedBox(camera_world(place) @ box.pose, box.size_m)
    box, T = parsed(BoxRecord.model_validate_json, content).box(), T_camera_cloud(place)
    return box if T is None else box.transformed(T)


@lru_cache(maxsize=256)
def world_box(content: str) -> OrientedBox:
    """The stored box of an object that stands still, in the frame of the world."""
    return parsed(WorldBox.model_validate_json, content).box()


def box_2d_of(content: str | None, names: Names) -> Box2D | None:
    """A 2D box."""
    return None if content is None else _named(parsed(BOX_2D.validate_json, content), names)


def _named(box: Box2D, names: Names) -> Box2D:
    return replace(box, label=parsed(_by_text(names).__getitem__, box.label))


@lru_cache(maxsize=64)
def _by_text(names: Names) -> dict[str, str]:
    return {str(number): name for number, name in names}


# --- what sources say -------------------------------------------------------------------------------------------------
# A row says what its source does, until something changes that. Then `said` keeps the words of the source.

_WORDS = ("class_id", "score", "box", "track_id", "box_kind", "attributes")


def stored_said(content: str) -> StoredSaid:
    """The column `said`, with the id of the class and the box in the frame of the cloud."""
    return parsed(StoredSaid.model_validate_json, content)


def said_json(row: Row, file_track_id: int | None = None) -> str:
    """What a row says, for its column `said`."""
    values = values_of(row["attributes"])
    said = {"source": row["of_source"] or OWN, "label": str(row["class_id"]), "box": parsed(json.loads, row["box"])}
    said |= {name: row[name] for name in ("score", "track_id", "box_kind")}
    return _text(said | {"attributes": values, "file_track_id": file_track_id, "given": values})


def said_with(content: str, attributes: Mapping[str, AttributeValue], given: Mapping[str, AttributeValue]) -> str:
    """What a source says, with other values; the same text for equal ones, since undo compares texts."""
    stored = parsed(json.loads, content)
    new = stored | {"attributes": dict(attributes), "given": dict(given)}
    return content if new == stored else _text(new)


def with_words(before: Row, after: Row) -> Row:
    """A changed label; what other software has said of it is kept where the row no longer says it."""
    if after["said"] is not None or None in (before["of_source"], after["of_source"]):
        return after
    if before["said"] is None:
        is_same = all(before[name] == after[name] for name in _WORDS)
        return after if is_same else after | {"said": said_json(before)}
    # an undo puts back columns of which others may have been changed meanwhile
    said = stored_said(before["said"])
    is_same = said.model_copy(update={"given": said.attributes}) == stored_said(said_json(after))
    return after if is_same else after | {"said": before["said"]}


def said_in(row: Mapping[str, Any], names: Names, place: Place) -> Said:
    """What the source of a box says, in its own words; ours says what its row has."""
    if row["of_source"] is not None and row["said"] is not None:
        stored = stored_said(row["said"])
        label, more = parsed(_by_text(names).__getitem__, stored.label), stored.file_track_id
        T, box = T_camera_cloud(place), stored.box.box()
        said = stored.said(box if T is None else box.transformed(T))
        return replace(said, label=label, attributes=stored.attributes, file_track_id=more)
    return Said(
        row["of_source"] or OWN,
        _by_text(names)[str(row["class_id"])],
        box_of(row["box"], place),
        row["score"],
        row["track_id"],
        BoxKind(row["box_kind"]),
        values_of(row["attributes"]),
    )


# --- values of attributes ---------------------------------------------------------------------------------------------


def values_of(content: str | None) -> dict[str, AttributeValue]:
    """The values in a column."""
    return {} if content in (None, "{}") else parsed(_values, content)


def _values(content: str) -> dict[str, AttributeValue]:
    values = json.loads(content)
    if not isinstance(values, dict) or not all(
        isinstance(value, bool | int | float | str) for value in values.values()
    ):
        raise ValueError("not values of attributes")
    return values


def values_json(values: Mapping[str, AttributeValue]) -> str:
    """Values as they are stored; equal values give equal texts."""
    return _text(values) if values else "{}"


def _text(content: Mapping[str, Any]) -> str:
    return json.dumps(dict(content), sort_keys=True, ensure_ascii=False, separators=(",", ":"))
