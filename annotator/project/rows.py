"""Columns of the tables as values, and back: classes by their names, boxes in the frame of the camera."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

from scipy.spatial.transform import RigidTransform
from sqlalchemy import Connection

from annotator.project.adjusting import moved_box, moved_geometry, moving
from annotator.project.database.store import driver_of
from annotator.project.records import BOX_2D, BOXES_2D, SAID, BoxRecord, SaidRecord, ViewGeometry, parsed
from annotator.types import Box2D, OrientedBox
from annotator.types.label import AttributeValue

Row = dict[str, Any]
"""A row of an audited table as SQLite has it: a Boolean is 0 or 1."""

Names = tuple[tuple[int, str], ...]


class Terms:
    """The names of the classes, and where the clouds lie, as of one transaction.

    Attributes:
        names: of the classes, by id; several may have the same.
    """

    def __init__(self, connection: Connection) -> None:
        self._driver = driver_of(connection)
        self.names: dict[int, str] = dict(self._driver.execute("SELECT id, name FROM classes ORDER BY id DESC"))
        self._ids = {name: number for number, name in self.names.items()}
        self._key: Names = tuple(self.names.items())
        stored = self._driver.execute("SELECT recording_id, correction FROM adjustments").fetchall()
        self._corrections = {id: correction for id, correction in stored if moving(correction) is not None}
        self._of_frames: dict[int | None, str | None] = {}

    # --- classes ------------------------------------------------------------------------------------------------------

    def known_id(self, name: str) -> int | None:
        """The id of a class; None if no row has had it yet."""
        return self._ids.get(name)

    def add(self, name: str) -> int:
        """Gives a class an id."""
        number = max(self.names, default=0) + 1
        self.names[number] = name
        self._ids[name] = number
        self._key = tuple(self.names.items())
        return number

    def _coded(self, box: Box2D) -> Box2D:
        return replace(box, label=str(self._ids[box.label]))

    # --- clouds -------------------------------------------------------------------------------------------------------

    def correction(self, frame_id: int | None) -> str | None:
        """The correction of a frame's recording, as it is stored; None if its cloud lies as it was recorded."""
        if not self._corrections:
            return None
        if frame_id not in self._of_frames:
            found = self._driver.execute("SELECT recording_id FROM frames WHERE id = ?", (frame_id,)).fetchone()
            self._of_frames[frame_id] = None if found is None else self._corrections.get(found[0])
        return self._of_frames[frame_id]

    def T_camera_cloud(self, frame_id: int | None) -> RigidTransform | None:
        """From the frame in which a frame's boxes are stored to that of the camera; None if they are the same."""
        correction = self.correction(frame_id)
        return None if correction is None else moving(correction)

    def _T_cloud_camera(self, frame_id: int | None) -> RigidTransform | None:
        T = self.T_camera_cloud(frame_id)
        return None if T is None else T.inv()

    # --- reading ------------------------------------------------------------------------------------------------------

    @property
    def key(self) -> Names:
        """The names, for caches."""
        return self._key

    def box(self, content: str, frame_id: int | None) -> OrientedBox:
        """A 3D box, camera frame."""
        return box_of(content, self.correction(frame_id))

    def record(self, content: str, frame_id: int | None) -> BoxRecord:
        """A 3D box, camera frame, bit for bit if no correction moves it."""
        record, T = parsed(BoxRecord.model_validate_json, content), self.T_camera_cloud(frame_id)
        return record if T is None else moved_box(record, T)

    def said(self, content: str | None, frame_id: int | None) -> tuple[SaidRecord, ...]:
        """What sources say of an object."""
        return () if content is None else said_of(content, self._key, self.correction(frame_id))

    def boxes_2d(self, content: str) -> tuple[Box2D, ...]:
        """2D boxes."""
        return tuple(_named(box, self._key) for box in parsed(BOXES_2D.validate_json, content))

    def geometry(self, content: str | None, frame_id: int | None) -> ViewGeometry | None:
        """The geometry of a pseudo-view."""
        if content is None:
            return None
        geometry, T = parsed(ViewGeometry.model_validate_json, content), self.T_camera_cloud(frame_id)
        if geometry.image_box is not None:
            geometry = geometry.model_copy(update={"image_box": _named(geometry.image_box, self._key)})
        return geometry if T is None else moved_geometry(geometry, T)

    # --- writing; all classes must have ids ---------------------------------------------------------------------------

    def box_json(self, box: BoxRecord, frame_id: int | None) -> str:
        """A 3D box as it is stored."""
        T = self._T_cloud_camera(frame_id)
        return (box if T is None else moved_box(box, T)).model_dump_json()

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

    def said_json(self, said: Sequence[SaidRecord], frame_id: int | None) -> str | None:
        """What the sources say of an object as it is stored; None if they say nothing."""
        if not said:
            return None
        T = self._T_cloud_camera(frame_id)
        coded = [
            each.model_copy(
                update={
                    "label": str(self._ids[each.label]),
                    "box": each.box if T is None else moved_box(each.box, T),
                }
            )
            for each in said
        ]
        return SAID.dump_json(tuple(coded), warnings="error").decode()


@lru_cache(maxsize=4096)
def box_of(content: str, correction: str | None) -> OrientedBox:
    """A stored box. A page reads all boxes of its frame again after each change of one."""
    box = parsed(BoxRecord.model_validate_json, content).box()
    T = None if correction is None else moving(correction)
    return box if T is None else box.transformed(T)


def said_of(content: str, names: Names, correction: str | None) -> tuple[SaidRecord, ...]:
    """What sources say of an object."""
    by_id, T = _by_text(names), None if correction is None else moving(correction)

    def read(text: str) -> tuple[SaidRecord, ...]:
        return tuple(
            each.model_copy(
                update={"label": by_id[each.label]} | ({} if T is None else {"box": moved_box(each.box, T)})
            )
            for each in SAID.validate_json(text)
        )

    return parsed(read, content)


def box_2d_of(content: str | None, names: Names) -> Box2D | None:
    """A 2D box."""
    return None if content is None else _named(parsed(BOX_2D.validate_json, content), names)


def _named(box: Box2D, names: Names) -> Box2D:
    return replace(box, label=parsed(_by_text(names).__getitem__, box.label))


@lru_cache(maxsize=64)
def _by_text(names: Names) -> dict[str, str]:
    return {str(number): name for number, name in names}


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
    return json.dumps(dict(values), sort_keys=True, ensure_ascii=False, separators=(",", ":"))


def number_or_none(value: float | None) -> float | None:
    """A number as it is stored: SQLite has NULL for NaN."""
    return None if value is None or math.isnan(value) else float(value)
