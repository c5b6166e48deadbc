"""Changes of the classes in the tables of the present state, values of frames, and counts of both."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, bindparam, delete, func, insert, select, update

from annotator.project.classes.attributes import Attribute, AttributeOf, Relabelling, value_text, values_json
from annotator.project.database.schema import (
    AnyRow,
    events,
    frame_attributes,
    frames,
    image_labels,
    labels,
    view_labels,
)
from annotator.project.log.event_types import PAYLOAD, ClassesChanged, ImageBoxesState, LabelState, ViewBoxesState
from annotator.project.log.records import (
    BOXES_2D,
    SaidRecord,
    ViewGeometry,
    box_2d_json,
    box_2d_of,
    parsed,
    said_json,
    said_of,
)
from annotator.types.errors import ProjectError
from annotator.types.label import AttributeValue
from annotator.types.messages import amount

CHANGED = "classes_changed"
_BATCH = 2000


def relabel(connection: Connection, change: Relabelling) -> None:
    """Changes all labels, 2D boxes and values of frames.

    Frames of which anything changes get a new revision, so that changes which are based on the earlier classes are
    refused.
    """
    if change == Relabelling():
        return
    changed = {*_labels(connection, change), *_frames(connection, change)}
    if change.changes_boxes:
        changed |= {*_images(connection, change), *_views(connection, change)}
    rows = [{"frame": frame_id} for frame_id in sorted(changed)]
    if rows:
        newer = update(frames).where(frames.c.id == bindparam("frame")).values(revision=frames.c.revision + 1)
        connection.execute(newer, rows)


def set_frame_values(
    connection: Connection, frame_id: int | None, values: Mapping[str, AttributeValue], event_id: int
) -> None:
    """Replaces the values of a frame."""
    connection.execute(delete(frame_attributes).where(frame_attributes.c.frame_id == frame_id))
    if values:
        row = {"frame_id": frame_id, "attributes": values_json(values), "event_id": event_id}
        connection.execute(insert(frame_attributes), row)


# Built once, since building this frequent query takes longer than running it.
_VALUES_OF_FRAME = select(frame_attributes.c.attributes).where(frame_attributes.c.frame_id == bindparam("frame"))


def frame_values(connection: Connection, frame_id: int | None) -> dict[str, AttributeValue]:
    """The values of a frame."""
    return values_of(connection.execute(_VALUES_OF_FRAME, {"frame": frame_id}).scalar())


def values_of(content: str | None) -> dict[str, AttributeValue]:
    """The values in a database column."""
    return {} if content in (None, "{}") else parsed(_values, content)


def _values(content: str) -> dict[str, AttributeValue]:
    values = json.loads(content)
    if not isinstance(values, dict) or not all(
        isinstance(value, bool | int | float | str) for value in values.values()
    ):
        raise ValueError("not values of attributes")
    return values


@dataclass(frozen=True)
class MadeChange:
    """A change of the classes, with the id, time (UTC nanoseconds since the epoch) and author of its event."""

    event_id: int
    time_ns: int
    author: str
    change: Relabelling


def made_changes(connection: Connection, event_id: int = 0) -> list[MadeChange]:
    """The changes of the classes after an event, in order."""
    query = select(events.c.id, events.c.time_ns, events.c.author, events.c.payload)
    query = query.where(events.c.kind == CHANGED, events.c.id > event_id).order_by(events.c.id)
    return [
        MadeChange(row.id, row.time_ns, row.author, payload.change)
        for row in connection.execute(query)
        if isinstance(payload := parsed(PAYLOAD.validate_json, row.payload), ClassesChanged)
    ]


class ClassChanges:
    """The changes of the classes over time, within one transaction."""

    def __init__(self, connection: Connection) -> None:
        self._made = made_changes(connection)

    def after_time(self, time_ns: int) -> tuple[Relabelling, ...]:
        """The changes after a time, UTC nanoseconds since the epoch."""
        return tuple(made.change for made in self._made if made.time_ns > time_ns)

    def label_state(self, state: str, event_id: int) -> str:
        """A label's state after the event `event_id` (as `read_state` returns it), changed by what came later.

        One of a removed class stays as it is; it cannot be restored.
        """
        label = parsed(LabelState.model_validate_json, state)
        for change in self._since(event_id):
            name = change.label(label.label)
            if name is None:
                return state
            attributes = change.values_of(name, label.attributes)
            values = {"label": name, "attributes": attributes, "said": _said(change, label.said)}
            label = label.model_copy(update=values | {"image_box": change.box(label.image_box)})
        return label.model_dump_json()

    def said_state(self, state: str, event_id: int) -> str | None:
        """What sources say, likewise; None if they say nothing any more."""
        said = said_of(state)
        for change in self._since(event_id):
            said = _said(change, said)
        return said_json(said)

    def image_state(self, state: str, event_id: int) -> str:
        """The state of the boxes on an image, likewise."""
        image = parsed(ImageBoxesState.model_validate_json, state)
        for change in self._since(event_id):
            image = image.model_copy(update={"boxes": change.boxes(image.boxes)})
        return image.model_dump_json()

    def view_state(self, state: str, event_id: int) -> str:
        """The state of the boxes on a pseudo-view, likewise."""
        view = parsed(ViewBoxesState.model_validate_json, state)
        for change in self._since(event_id):
            boxes, geometry = change.boxes(view.boxes), _geometry(change, view.geometry)
            if view.boxes and not boxes:
                return state
            view = view.model_copy(update={"boxes": boxes, "geometry": geometry})
        return view.model_dump_json()

    def frame_state(self, state: str, event_id: int) -> str | None:
        """The values of a frame, likewise."""
        values = values_of(state)
        for change in self._since(event_id):
            values = change.values(values)
        return values_json(values) if values else None

    def has_since(self, event_id: int) -> bool:
        """Whether there were changes after an event."""
        return bool(self._made) and self._made[-1].event_id > event_id

    def _since(self, event_id: int) -> Iterator[Relabelling]:
        return (made.change for made in self._made if made.event_id > event_id)


def _labels(connection: Connection, change: Relabelling) -> set[int]:
    names = ("id", "frame_id", "label", "attributes", "image_box", "said")
    columns = tuple(labels.c[name] for name in names)
    frames_changed, removed, changed = set[int](), list[int](), list[dict[str, Any]]()
    for row in _batches(connection, select(*columns), labels.c.id):
        name = change.label(row.label)
        if name is None:
            removed.append(row.id)
            frames_changed.add(row.frame_id)
            continue
        values = values_json(change.values_of(name, values_of(row.attributes)))
        image_box = box_2d_json(change.box(box_2d_of(row.image_box))) if change.changes_boxes else row.image_box
        said = None if row.said is None else said_json(_said(change, said_of(row.said)))
        if (name, values, image_box, said) != (row.label, row.attributes, row.image_box, row.said):
            changed.append({"row": row.id, "name": name, "values": values, "drawn": image_box, "sources": said})
            frames_changed.add(row.frame_id)
    if removed:
        connection.execute(delete(labels).where(labels.c.id == bindparam("row")), [{"row": id} for id in removed])
    if changed:
        new: dict[str, Any] = {
            "label": bindparam("name"),
            "attributes": bindparam("values"),
            "image_box": bindparam("drawn"),
            "said": bindparam("sources"),
        }
        connection.execute(update(labels).where(labels.c.id == bindparam("row")).values(new), changed)
    return frames_changed


def _said(change: Relabelling, said: Iterable[SaidRecord]) -> tuple[SaidRecord, ...]:
    """What sources say of an object; nothing of removed classes."""
    new = list[SaidRecord]()
    for each in said:
        name = change.label(each.label)
        if name is None:
            continue
        values = change.values_of(name, each.attributes)
        # values that are filled in are not lent
        lent = change.values({of: each.attributes[of] for of in each.lent}).keys() & values.keys()
        new.append(each.model_copy(update={"label": name, "attributes": values, "lent": tuple(sorted(lent))}))
    return tuple(new)


def _frames(connection: Connection, change: Relabelling) -> set[int]:
    changed = set[int]()
    for row in connection.execute(select(frame_attributes)).all():
        before = values_of(row.attributes)
        after = change.values(before)
        if after != before:
            set_frame_values(connection, row.frame_id, after, row.event_id)
            changed.add(row.frame_id)
    return changed


def _images(connection: Connection, change: Relabelling) -> set[int]:
    changed = set[int]()
    for row in _batches(connection, select(image_labels), image_labels.c.frame_id):
        before = parsed(BOXES_2D.validate_json, row.boxes)
        after = change.boxes(before)
        if after != before:
            new = {"boxes": BOXES_2D.dump_json(after).decode(), "count": len(after)}
            connection.execute(update(image_labels).where(image_labels.c.frame_id == row.frame_id).values(new))
            changed.add(row.frame_id)
    return changed


def _views(connection: Connection, change: Relabelling) -> set[int]:
    changed = set[int]()
    for row in _batches(connection, select(view_labels), view_labels.c.id):
        before = parsed(BOXES_2D.validate_json, row.boxes)
        geometry = None if row.geometry is None else parsed(ViewGeometry.model_validate_json, row.geometry)
        after, moved = change.boxes(before), _geometry(change, geometry)
        if (after, moved) == (before, geometry):
            continue
        same = view_labels.c.id == row.id
        if before and not after:
            # a view without boxes would say that it shows no object
            connection.execute(delete(view_labels).where(same))
        else:
            new: dict[str, Any] = {"boxes": BOXES_2D.dump_json(after).decode(), "count": len(after)}
            new["geometry"] = None if moved is None else moved.model_dump_json()
            connection.execute(update(view_labels).where(same).values(new))
        if row.frame_id is not None:
            changed.add(row.frame_id)
    return changed


def _geometry(change: Relabelling, geometry: ViewGeometry | None) -> ViewGeometry | None:
    if geometry is None or geometry.image_box is None:
        return geometry
    return geometry.model_copy(update={"image_box": change.box(geometry.image_box)})


def _batches(connection: Connection, query: Any, key: Any) -> Iterator[AnyRow]:
    """Yields rows in order of a key, read in batches, so that a large project needs little memory."""
    after = -1
    while rows := connection.execute(query.where(key > after).order_by(key).limit(_BATCH)).all():
        yield from rows
        after = getattr(rows[-1], key.name)


# --- counting classes and values --------------------------------------------------------------------------------------

# the shown box is a source's, too
_SAID = """
    SELECT json_extract(said.value, '$.label') AS name, count(*) FROM labels, json_each(labels.said) AS said
    WHERE json_extract(said.value, '$.uid') != labels.uid OR name != labels.label GROUP BY name
"""

_Stored = tuple[str | None, Mapping[str, AttributeValue], int]
"""Class (None: of frames), values and how often they occur together."""


@dataclass(frozen=True)
class ClassCounts:
    """Numbers of boxes of a class.

    Attributes:
        labels: 3D labels.
        boxes_2d: 2D boxes on images and views.
        said: what sources say of objects, apart from the boxes that are shown.
    """

    labels: int = 0
    boxes_2d: int = 0
    said: int = 0


def class_counts(connection: Connection) -> dict[str, ClassCounts]:
    """Numbers of boxes by class name."""
    count = func.count().label("number")
    of_labels = connection.execute(select(labels.c.label, count).group_by(labels.c.label))
    in_3d: dict[str, int] = {row[0]: row[1] for row in of_labels}
    in_2d: Counter[str] = Counter()
    for table in ("image_labels", "view_labels"):
        of_boxes = f"{table}, json_each({table}.boxes) AS box"
        query = f"SELECT json_extract(box.value, '$.label'), count(*) FROM {of_boxes} GROUP BY 1"
        in_2d.update({row[0]: row[1] for row in connection.exec_driver_sql(query)})
    said = {row[0]: row[1] for row in connection.exec_driver_sql(_SAID)}
    names = sorted({*in_3d, *in_2d, *said})
    return {name: ClassCounts(in_3d.get(name, 0), in_2d[name], said.get(name, 0)) for name in names}


@dataclass(frozen=True)
class ValueCounts:
    """How often values of attributes occur, by attribute.

    Attributes:
        values: by value.
        without: labels and frames that have no value, but could have one.
    """

    values: dict[str, dict[str, int]]
    without: dict[str, int]


def value_counts(connection: Connection) -> dict[str, dict[str, int]]:
    """How often each stored value occurs, by attribute: of labels that are not rejected, and of frames."""
    return _by_name(_counted(_stored(connection)))


def counts_with_defaults(connection: Connection, attributes: Sequence[Attribute]) -> ValueCounts:
    """As `value_counts`, with the default of a frames' attribute for all frames that have no value.

    These are all frames that the latest scans found, labelled or not, since labels are counted before their review,
    too. Exports write the default for those of them that they contain.

    Args:
        attributes: of the project; those without any value have an entry, too.
    """
    stored = list(_stored(connection))
    counts, without = _counted(stored), dict[str, int]()
    boxes = _boxes_without(connection, stored, attributes)
    frames_found, frames_with = _frames_found(connection), _frames_with(connection)
    for each in attributes:
        missing = boxes[each.name]
        if each.of is AttributeOf.FRAME:
            missing = frames_found - frames_with[each.name]
            if each.default is not None and missing:
                counts[each.name][value_text(each.default)] += missing
                missing = 0
        counts.setdefault(each.name, Counter())
        without[each.name] = missing
    return ValueCounts(_by_name(counts), without)


def require_fitting(connection: Connection, before: Sequence[Attribute], after: Sequence[Attribute]) -> None:
    """Refuses a change of attributes that stored values do not fit."""
    for attribute in after:
        if any(attribute.has_same_values(each) for each in before):
            continue
        wrong = list(_misfits(connection, attribute))
        if wrong:
            number, example = sum(number for number, _ in wrong), wrong[0][1]
            raise ProjectError(
                f"{amount(number, 'stored value')} of {attribute.name} would not fit, such as {example}; first change "
                "what does not fit, or have it removed (--drop)"
            )


def _counted(stored: Iterable[_Stored]) -> dict[str, Counter[str]]:
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for _, values, number in stored:
        for name, value in values.items():
            counts[name][value_text(value)] += number
    return counts


def _by_name(counts: Mapping[str, Counter[str]]) -> dict[str, dict[str, int]]:
    return {name: dict(counts[name].most_common()) for name in sorted(counts)}


def _boxes_without(connection: Connection, stored: Iterable[_Stored], attributes: Sequence[Attribute]) -> Counter[str]:
    """Labels of an attribute's classes that have no value of it."""
    of_classes = select(labels.c.label, func.count()).where(labels.c.state != "rejected").group_by(labels.c.label)
    without: Counter[str] = Counter()
    for label, number in connection.execute(of_classes):
        without.update({each.name: number for each in attributes if each.is_of(label)})
    for label, values, number in stored:
        if label is not None:
            without.subtract({each.name: number for each in attributes if each.is_of(label) and each.name in values})
    return without


def _frames_found(connection: Connection) -> int:
    return int(connection.execute(select(func.count()).where(frames.c.position.is_not(None))).scalar_one())


def _frames_with(connection: Connection) -> Counter[str]:
    """Frames that the latest scans found and that have a value of their own, by attribute."""
    query = select(frame_attributes.c.attributes, func.count()).join(frames).where(frames.c.position.is_not(None))
    counts: Counter[str] = Counter()
    for text, number in connection.execute(query.group_by(frame_attributes.c.attributes)):
        counts.update(dict.fromkeys(values_of(text), number))
    return counts


def _misfits(connection: Connection, attribute: Attribute) -> Iterator[tuple[int, str]]:
    for label, values, number in _stored(connection, rejected=True):
        if attribute.name not in values or (label is None) != (attribute.of is AttributeOf.FRAME):
            continue
        value = values[attribute.name]
        if label is not None and not attribute.is_of(label):
            yield number, f"{value!r} of a {label}"
        elif not attribute.fits(value):
            yield number, repr(value)


def _stored(connection: Connection, rejected: bool = False) -> Iterator[_Stored]:
    columns = (labels.c.label, labels.c.attributes)
    query = select(*columns, func.count()).where(labels.c.attributes != "{}").group_by(*columns)
    if not rejected:
        query = query.where(labels.c.state != "rejected")
    for label, content, number in connection.execute(query):
        yield label, values_of(content), number
    for row in connection.execute(select(frame_attributes.c.attributes)):
        yield None, values_of(row.attributes), 1
