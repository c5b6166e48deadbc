"""Changes of the classes and attributes: their rows, and the rows of boxes and frames that follow. One action each."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from pydantic import ValidationError
from sqlalchemy import Connection, select

from annotator.project.audit.events import CLASSES, read_events
from annotator.project.audit.writing import Write, WriteContext
from annotator.project.classes.attributes import Attribute, ClassStyle
from annotator.project.classes.counts import require_fitting
from annotator.project.classes.edit import ClassEdit
from annotator.project.config import ProjectConfig, ProjectFile, whole_config
from annotator.project.database.schema import AUDITED, columns_of, events
from annotator.project.database.store import Store, driver_of
from annotator.project.log import new_action, next_revision
from annotator.project.rows import Row, Terms, box_2d_of, said_with, stored_said, values_json, values_of
from annotator.project.sources import KIND as IMPORTED
from annotator.project.sources import regroup
from annotator.types import Source
from annotator.types.errors import ProjectError
from annotator.types.label import AttributeValue
from annotator.types.messages import first_problem

# The kinds of events: with rows of classes and attributes, also of their undo; with the rows that follow these.
KIND, FOLLOWED = "classes_changed", "classes_followed"
# Rows that are read, and changed by one event, at once: a project may have 100,000.
BATCH = 2000


def change_classes(store: Store, connection: Connection, made: ClassEdit, author: str) -> None:
    """Changes the rows, within the caller's write transaction.

    Frames of which anything changes get a new revision, so that changes which are based on the earlier classes are
    refused.
    """
    action = new_action()
    write = write_classes(store, connection, WriteContext(0, author, effort_target=made.words), action)
    classes, attributes = write.terms.classes, write.terms.attributes
    _put_classes(write, made.config, made.names)
    write.event(KIND, CLASSES)
    write.finish()
    for batch in _changed_rows(connection, made) if made.values or made.removed else ():
        write = write_classes(store, connection, WriteContext(0, author), action)
        for table, row, after in batch:
            write.know(table, row[AUDITED[table]], row)
            write.put(table, row[AUDITED[table]], after)
        write.event(FOLLOWED, CLASSES)
        write.finish()
    if made.removed:
        _show_others(store, connection, author, action)
    require_consistent(connection, classes, attributes)


def set_up_classes(store: Store, connection: Connection, config: ProjectConfig, author: str) -> None:
    """Writes the classes of a new project, which cannot be undone."""
    write = write_classes(store, connection, WriteContext(0, author), None)
    _put_classes(write, config, {})
    write.event(KIND, CLASSES)
    write.finish()


def write_classes(store: Store, connection: Connection, context: WriteContext, action: str | None) -> Write:
    """A write of the classes, or of the rows that follow; sets the context's revision."""
    context = replace(context, revision=next_revision(connection, CLASSES) - 1)
    return Write(store, connection, None, "the classes", context, action)


def require_consistent(connection: Connection, classes: Sequence[str], attributes: Sequence[Attribute]) -> None:
    """Refuses a change from these classes and attributes, which has been made, if they, or the rows, do not fit."""
    try:
        whole_config(ProjectFile(name="", created_ns=0), Terms(connection))
    except ValidationError as error:
        raise ProjectError(first_problem(error)) from error
    require_fitting(connection, classes, attributes)


def _put_classes(write: Write, new: ProjectConfig, renamed: Mapping[str, str]) -> None:
    """Puts the rows of the classes and attributes."""
    terms, rows = write.terms, dict[int, Row]()
    for number, name in terms.names.items():
        named = {"id": number, "name": renamed.get(name, name)}
        rows[number] = named | {"position": None, "colour": None, "shortcut": None, "still": None}
    ids = dict[str, int]()
    for position, name in enumerate(new.classes):
        old = [before for before, after in renamed.items() if after == name]
        before = name if name in terms.classes or not old else old[0]
        # a class that was removed gets its id back
        ids[name] = number = terms.ids.get(before, max(rows, default=0) + 1)
        style = new.class_styles.get(name, ClassStyle())
        looks = {
            "position": position,
            "colour": style.colour,
            "shortcut": style.key,
            "still": None if style.still is None else int(style.still),
        }
        rows[number] = {"id": number, "name": name} | looks
    for number, row in rows.items():
        write.put("classes", number, row)
    for position, each in enumerate(new.attributes):
        fields = each.model_dump(mode="json", exclude={"name"})
        if each.classes:
            fields["classes"] = [ids[name] for name in each.classes]
        content = json.dumps(fields, ensure_ascii=False, separators=(",", ":"))
        write.put("attributes", each.name, {"name": each.name, "position": position, "content": content})
    for name in {each.name for each in terms.attributes} - {each.name for each in new.attributes}:
        write.put("attributes", name, None)


def _show_others(store: Store, connection: Connection, author: str, action: str) -> None:
    """Shows other sources' boxes where the one before them was of a removed class."""
    query = (
        "SELECT DISTINCT frames.id, frames.revision FROM labels JOIN frames ON frames.id = frame_id "
        "WHERE behind IS NOT NULL AND behind NOT IN (SELECT uid FROM labels) ORDER BY frames.id"
    )
    for frame_id, revision in driver_of(connection).execute(query).fetchall():
        # the frame may be finalised, or of a removed recording
        context = WriteContext(revision, author, Source.IMPORTED)
        write = Write(store, connection, frame_id, f"frame with id {frame_id}", context, action)
        regroup(write, write.open_proposals())
        write.event(IMPORTED)
        write.finish()


def _changed_rows(connection: Connection, change: ClassEdit) -> Iterator[list[tuple[str, Row, Row | None]]]:
    """Yields the rows that a change of attributes, or a removed class, changes: table, before, after."""
    terms = Terms(connection)
    for table in ("labels", "stills", "frames", "image_labels", "view_labels"):
        if table in ("image_labels", "view_labels") and not change.removed:
            continue
        for rows in _batches(connection, table):
            changed = ((table, row, _changed(terms, change, table, row)) for row in rows)
            if batch := [(table, row, after) for table, row, after in changed if after != row]:
                yield batch


def _batches(connection: Connection, table: str) -> Iterator[list[Row]]:
    columns, after = columns_of(table), -1
    listed = ", ".join(f'"{column}"' for column in columns)
    query = f"SELECT rowid, {listed} FROM {table} WHERE rowid > ? ORDER BY rowid LIMIT {BATCH}"
    while found := driver_of(connection).execute(query, (after,)).fetchall():
        yield [dict(zip(columns, values[1:], strict=True)) for values in found]
        after = found[-1][0]


def _changed(terms: Terms, change: ClassEdit, table: str, row: Row) -> Row | None:
    """A row after the change; None if it goes."""
    if table == "frames":
        values = _values(change, None, values_of(row["attributes"]))
        return row | {"attributes": values_json(values) if values else None}
    if table in ("labels", "stills"):
        return _changed_label(terms, change, row)
    boxes = terms.boxes_2d(row["boxes"])
    left = [box for box in boxes if box.label != change.removed]
    if table == "view_labels":
        # a view without boxes would say that it shows no object
        if boxes and not left:
            return None
        geometry = terms.geometry(row["geometry"], row["frame_id"])
        if geometry is not None and geometry.image_box is not None and geometry.image_box.label == change.removed:
            geometry = geometry.model_copy(update={"image_box": None})
            row = row | {"geometry": terms.geometry_json(geometry, row["frame_id"])}
    return row if len(left) == len(boxes) else row | {"boxes": terms.boxes_2d_json(left), "count": len(left)}


def _changed_label(terms: Terms, change: ClassEdit, row: Row) -> Row | None:
    name = terms.names[row["class_id"]]
    if name == change.removed:
        return None
    after = row | {"attributes": values_json(_values(change, name, values_of(row["attributes"])))}
    image_box = box_2d_of(row.get("image_box"), terms.key)
    if image_box is not None and image_box.label == change.removed:
        after["image_box"] = None
    if row.get("said") is not None:
        said = stored_said(row["said"])
        if (label := terms.names[int(said.label)]) == change.removed:
            return after | {"said": None, "of_source": None}
        own, given = (_values(change, label, values) for values in (said.attributes, said.given))
        after["said"] = said_with(row["said"], own, given)
    return after


def _values(change: ClassEdit, label: str | None, values: Mapping[str, AttributeValue]) -> Mapping[str, AttributeValue]:
    return values if change.values is None else change.values(label, values)


# --- what was changed -------------------------------------------------------------------------------------------------

_OF_CLASSES = (events.c.view_id == CLASSES) & events.c.frame_id.is_(None) & (events.c.kind == KIND)


@dataclass(frozen=True)
class MadeChange:
    """A change of the classes, or its undo: who made it, and the old name of each renamed class -> the new one."""

    author: str
    renamed: dict[str, str]


def made_changes(connection: Connection, event_id: int) -> list[MadeChange]:
    """The changes of the classes after an event, in order."""
    return [
        MadeChange(
            event.author,
            {
                row.before["name"]: row.after["name"]
                for row in event.rows
                if row.table == "classes" and row.before and row.after and "name" in row.after
            },
        )
        for event in read_events(connection, select(events).where(_OF_CLASSES), event_id)
    ]


def present_names(connection: Connection, names: Sequence[str], time_ns: int) -> dict[str, str | None]:
    """Names that classes had at a time (UTC nanoseconds) -> their present names; None for a removed class."""
    then, terms = dict[int, Row](), Terms(connection)
    for event in read_events(connection, select(events).where(_OF_CLASSES, events.c.time_ns <= time_ns)):
        for row in event.rows:
            if row.table == "classes":
                then[int(row.key)] = then.get(int(row.key), {}) | (row.after or {})
    ids = {row["name"]: number for number, row in then.items() if row["position"] is not None}
    now = {name: terms.names[number] for name, number in ids.items()}
    return {name: after if (after := now.get(name, name)) in {*terms.classes, name} else None for name in names}
