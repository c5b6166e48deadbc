"""Changes of the classes and attributes: what they do to the rows, and to states from before them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, func, insert, select

from annotator.project.audit.events import CLASSES
from annotator.project.audit.writing import Write, WriteContext
from annotator.project.classes.attributes import Relabelling
from annotator.project.config import ProjectConfig, config_hash
from annotator.project.database.schema import AUDITED, class_changes, columns_of, events
from annotator.project.database.store import driver_of
from annotator.project.log import Writer
from annotator.project.records import parsed
from annotator.project.rows import Row, Terms, box_2d_of, said_with, values_json, values_of
from annotator.project.sources import KIND as IMPORTED
from annotator.project.sources import regroup
from annotator.types import Source

KIND = "classes_changed"
# Rows that are read, and changed by one event, at once: a project may have 100,000.
_BATCH = 2000


def change_classes(
    writer: Writer, connection: Connection, old: ProjectConfig, new: ProjectConfig, change: Relabelling, author: str
) -> int:
    """Changes the rows, within the caller's write transaction; returns the number of the change.

    Frames of which anything changes get a new revision, so that changes which are based on the earlier classes are
    refused.
    """
    newest = connection.execute(select(func.coalesce(func.max(events.c.id), 0))).scalar_one()
    stale = set[int]()
    of_classes = (events.c.view_id == CLASSES) & events.c.frame_id.is_(None)  # as the index has it
    query = select(func.max(events.c.revision)).where(of_classes)
    revision = connection.execute(query).scalar() or 0
    write = _write(writer, connection, revision, author, old)
    for number, name in list(write.terms.names.items()):
        if name in change.classes:
            write.put("classes", number, {"id": number, "name": change.classes[name]})
            stale |= _frames_of(connection, number)
    write.event(KIND, CLASSES)
    revision = write.finish().revision
    for batch in _changed_rows(connection, change) if change.changes_rows else ():
        write = _write(writer, connection, revision, author, old)
        for table, before, after in batch:
            key = before[AUDITED[table]]
            write.know(table, key, before)
            write.put(table, key, after)
            if (frame_id := before["id"] if table == "frames" else before["frame_id"]) is not None:
                stale.add(frame_id)
        write.event(KIND, CLASSES)
        revision = write.finish().revision
    driver = driver_of(connection)
    moments = {driver.execute("SELECT moment_id FROM frames WHERE id = ?", (id,)).fetchone() for id in stale}
    driver.executemany("UPDATE frames SET revision = revision + 1 WHERE moment_id = ?", sorted(moments))
    if change.removed:
        _show_others(writer, connection, old, author)
    row = {"event_id": newest, "author": author, "time_ns": writer.store.clock()}
    row |= {"content": change.model_dump_json(), "config": config_hash(new)}
    key = connection.execute(insert(class_changes), row).inserted_primary_key
    assert key is not None  # one row was inserted
    return int(key[0])


def _write(
    writer: Writer,
    connection: Connection,
    revision: int,
    author: str,
    config: ProjectConfig,
    frame_id: int | None = None,
) -> Write:
    where = "the classes" if frame_id is None else f"frame with id {frame_id}"
    context = WriteContext(revision, author, Source.MANUAL if frame_id is None else Source.IMPORTED)
    return Write(writer.store, writer.folder, connection, frame_id, where, context, None, config)


def _frames_of(connection: Connection, class_id: int) -> set[int]:
    """Frames with boxes of a class, hidden ones included."""
    named = f'"label":"{class_id}"'
    queries = (
        "SELECT frame_id FROM labels WHERE class_id = :id OR instr(ifnull(said, '') || ifnull(image_box, ''), :named)",
        "SELECT frame_id FROM image_labels WHERE instr(boxes, :named)",
        "SELECT frame_id FROM view_labels WHERE frame_id IS NOT NULL AND instr(boxes || ifnull(geometry, ''), :named)",
    )
    found = driver_of(connection).execute(" UNION ".join(queries), {"id": class_id, "named": named})
    return {frame_id for (frame_id,) in found}


def _show_others(writer: Writer, connection: Connection, config: ProjectConfig, author: str) -> None:
    """Shows other sources' boxes where the one before them was of a removed class."""
    query = (
        "SELECT DISTINCT frames.id, frames.revision FROM labels JOIN frames ON frames.id = frame_id "
        "WHERE behind IS NOT NULL AND behind NOT IN (SELECT uid FROM labels) ORDER BY frames.id"
    )
    for frame_id, revision in driver_of(connection).execute(query).fetchall():
        # the frame may be finalised, or of a removed recording
        write = _write(writer, connection, revision, author, config, frame_id)
        regroup(write, write.open_proposals())
        write.event(IMPORTED)
        write.finish()


def _changed_rows(connection: Connection, change: Relabelling) -> Iterator[list[tuple[str, Row, Row | None]]]:
    """Yields the rows that a change of attributes, or a removed class, changes: table, before, after."""
    terms = Terms(connection)
    for table in ("labels", "frames", "image_labels", "view_labels"):
        if table in ("image_labels", "view_labels") and not change.removed:
            continue
        for rows in _batches(connection, table):
            batch = list[tuple[str, Row, Row | None]]()
            for row in rows:
                after = _changed(terms, change, table, row)
                if after != row:
                    batch.append((table, row, after))
            if batch:
                yield batch


def _batches(connection: Connection, table: str) -> Iterator[list[Row]]:
    columns, after = columns_of(table), -1
    listed = ", ".join(f'"{column}"' for column in columns)
    query = f"SELECT rowid, {listed} FROM {table} WHERE rowid > ? ORDER BY rowid LIMIT {_BATCH}"
    while found := driver_of(connection).execute(query, (after,)).fetchall():
        yield [dict(zip(columns, values[1:], strict=True)) for values in found]
        after = found[-1][0]


def _changed(terms: Terms, change: Relabelling, table: str, row: Row) -> Row | None:
    """A row after the change; None if it goes."""
    if table == "frames":
        values = change.values(values_of(row["attributes"]))
        return row | {"attributes": values_json(values) if values else None}
    if table == "labels":
        name = terms.names[row["class_id"]]
        if name in change.removed:
            return None
        return row | values_after(terms, [change], name, row)
    boxes = terms.boxes_2d(row["boxes"])
    left = [box for box in boxes if box.label not in change.removed]
    if table == "view_labels":
        # a view without boxes would say that it shows no object
        if boxes and not left:
            return None
        geometry = terms.geometry(row["geometry"], row["frame_id"])
        if geometry is not None and geometry.image_box is not None and geometry.image_box.label in change.removed:
            geometry = geometry.model_copy(update={"image_box": None})
            row = row | {"geometry": terms.geometry_json(geometry, row["frame_id"])}
    return row if len(left) == len(boxes) else row | {"boxes": terms.boxes_2d_json(left), "count": len(left)}


# --- states from before a change --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MadeChange:
    """A change of the classes, with its time (UTC nanoseconds since the epoch) and author."""

    time_ns: int
    author: str
    change: Relabelling


def made_changes(connection: Connection, event_id: int = 0) -> list[MadeChange]:
    """The changes of the classes after an event, in order."""
    query = select(class_changes).where(class_changes.c.event_id >= event_id).order_by(class_changes.c.id)
    return [
        MadeChange(row.time_ns, row.author, parsed(Relabelling.model_validate_json, row.content))
        for row in connection.execute(query)
    ]


def values_after(terms: Terms, changes: Sequence[Relabelling], label: str, row: Row) -> Row:
    """The columns of a label that changes of the classes and attributes change, as far as the row has them."""
    after: Row = {}
    if (image_box := box_2d_of(row.get("image_box"), terms.key)) is not None:
        is_gone = any(image_box.label in change.removed for change in changes)
        after["image_box"] = None if is_gone else row["image_box"]
    if "attributes" in row:
        values = values_of(row["attributes"])
        for change in changes:
            values = change.values_of(label, values)
        after["attributes"] = values_json(values)
    if row.get("said") is not None:
        said = terms.said(row["said"], None)
        own, given = dict(said.attributes), dict(said.given)
        for change in changes:
            own, given = change.values_of(said.label, own), change.values_of(said.label, given)
        is_gone = any(said.label in change.removed for change in changes)
        after |= {"said": None, "of_source": None} if is_gone else {"said": said_with(row["said"], own, given)}
    return after
