"""What waits for a review, in the order in which it is to be shown."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from sqlalchemy import ColumnElement, Float, Select, Table, Text, and_, case, cast, func, literal, null, select

from annotator.project.classes.attributes import Value, value_text
from annotator.project.database.schema import ALL_LABELS, AnyRow, frames, own_labels, sightings, still_labels
from annotator.project.database.store import Store
from annotator.project.frames import FRAME_COLUMNS, StoredFrame
from annotator.project.records import OWN
from annotator.project.rows import Terms
from annotator.types import ReviewState

_BEHIND = ALL_LABELS.alias()
labels = own_labels
# An open object that stands still waits once: in the frame that sees most of it.
_MOST = func.max(sightings.c.points * (1.0 - sightings.c.hidden_share)).label("most")
_OPEN_STILLS = (
    select(still_labels.c.id, _MOST)  # SQLite takes the id from the row with the maximum
    .join(sightings, sightings.c.uid == still_labels.c.uid)
    .join(frames, frames.c.id == still_labels.c.frame_id)
    .where(still_labels.c.state == ReviewState.PROPOSED.value, frames.c.position.is_not(None), ~frames.c.finalised)
    .group_by(sightings.c.still)
    .subquery()
)


@dataclass(frozen=True)
class ValueFilter:
    """What the value of an attribute must be. Without any condition: there is no value.

    Attributes:
        of_frame: it is one of frames, not of boxes and tracks.
        usual: of frames that have no value of their own.
        known: any value will do.
        contains: part of the value as text; small and capital letters (a to z) count as equal.
    """

    name: str
    of_frame: bool = False
    usual: Value | None = None
    known: bool = False
    text: str | None = None
    contains: str | None = None
    low: float | None = None
    high: float | None = None

    def clause(self, of: Table) -> ColumnElement[bool]:
        """The condition of a query of labels (`of`) joined with their frames."""
        found = self._value(of)
        conditions = {
            "text": lambda text: found == text,
            "contains": lambda part: func.instr(func.lower(found), func.lower(part)) > 0,
            "low": lambda low: cast(found, Float) >= low,
            "high": lambda high: cast(found, Float) <= high,
        }
        given = [is_met(value) for name, is_met in conditions.items() if (value := getattr(self, name)) is not None]
        if not given:
            return found.is_not(None) if self.known else found.is_(None)
        return and_(*given)

    def _value(self, of: Table) -> ColumnElement[str]:
        """The value as text; NULL without one."""
        column = frames.c.attributes if self.of_frame else of.c.attributes
        values = func.json_each(column).table_valued("key", "value", "type")
        known = case((values.c.type.in_(("true", "false")), values.c.type), else_=cast(values.c.value, Text))
        found = select(known).select_from(values).where(values.c.key == self.name).scalar_subquery()
        return found if self.usual is None else func.coalesce(found, literal(value_text(self.usual)))


# --- open proposals in order of their doubt ---------------------------------------------------------------------------
# The database sorts them, since a project may have 100,000 and more.


MAX_DOUBT = 0.7
# The good and the bad value of each signal, between which its doubt grows linearly to MAX_DOUBT; all are columns of
# `labels`: shares of the box's size and of points, 1 - IoU (twice), score, 1 - IoU.
SIGNALS = {
    "view_disagreement": (0.0, 0.25),
    "kept_share": (1.0, 0.1),
    "last_change": (0.0, 0.3),
    "image_agreement": (1.0, 0.4),
    "score": (1.0, 0.0),
    "expected_iou_loss": (0.0, 0.5),
}


class By(StrEnum):
    """The order of proposals; equal ones are in the order of frames and labels."""

    DOUBT = "doubt"
    FRAME = "frame"
    CLASS = "class"
    TRACK = "track"


@dataclass(frozen=True)
class QueueItem:
    """A proposal to review, or (without uid and label) a frame to label.

    Attributes:
        doubt: in 0..1, if any signal has a value.
        sources: all that see the object, that of the shown box first; `OWN` for annotator itself.
        heading: of the proposal's box, a unit vector in the camera frame.
    """

    frame: StoredFrame
    uid: str | None
    label: str | None
    doubt: float | None
    sources: tuple[str, ...] = ()
    heading: tuple[float, ...] | None = None


def waiting(
    store: Store,
    by: By,
    *,
    recordings: Collection[int] | None = None,
    classes: Collection[str] | None = None,
    attribute: ValueFilter | None = None,
    source: str | None = None,
    most: int | None = None,
) -> tuple[tuple[QueueItem, ...], int]:
    """Returns the first open proposals on frames that are neither finalised nor gone, and the number of all.

    Args:
        source: only of objects that this source sees; `OWN` for annotator itself.
    """
    rows, total = list[AnyRow](), 0
    with store.read() as connection:
        terms = Terms(connection)
        for of in (own_labels, still_labels)[: 1 + terms.has_stills]:
            is_open = _is_open(recordings, classes, of)
            if attribute is not None:
                is_open &= attribute.clause(of)
            if source is not None:
                is_open &= _is_said_by(source, of)
            rows += connection.execute(_first(by, is_open, most, of))
            total += int(connection.execute(_of_frames(select(func.count()), of).where(is_open)).scalar_one())
    if terms.has_stills:
        rows.sort(key=lambda row: tuple(row[-len(_order(by, labels)) :]))
    return tuple(_item(row, terms) for row in rows[:most]), total


def _first(by: By, is_open: ColumnElement[bool], most: int | None, of: Table) -> Select[Any]:
    """The first open proposals; the last columns are those of the order."""
    order, doubt = _order(by, of), label_doubt(of)
    # the long columns are read of the first ones only
    first = _of_frames(select(of.c.id), of).where(is_open).order_by(*order).limit(most)
    further = select(func.json_group_array(func.json_array(_BEHIND.c.score, func.coalesce(_BEHIND.c.of_source, OWN))))
    further_of = further.where(_BEHIND.c.behind == of.c.uid).scalar_subquery().label("further")
    columns = (of.c.uid, of.c.label, of.c.of_source, further_of, doubt.label("doubt"), of.c.box)
    ordered = [each.label(f"order_{number}") for number, each in enumerate(order)]
    return _of_frames(select(*FRAME_COLUMNS, *columns, *ordered), of).where(of.c.id.in_(first)).order_by(*order)


def _item(row: AnyRow, terms: Terms) -> QueueItem:
    frame = StoredFrame(*row[: len(FRAME_COLUMNS)])
    heading = tuple(terms.box(row.box, frame.id).rotation[:, 0].tolist())
    return QueueItem(frame, row.uid, row.label, row.doubt, _sources(row), heading)


def waiting_sources(store: Store) -> dict[str, int]:
    """The number of objects that each source sees among the open proposals of `waiting`, by its name."""
    hidden = select(func.coalesce(_BEHIND.c.of_source, OWN), func.count()).select_from(labels)
    queries = [(hidden.join(_BEHIND, _BEHIND.c.behind == labels.c.uid), labels)]
    queries += [
        (select(func.coalesce(of.c.of_source, OWN), func.count()).select_from(of), of) for of in (labels, still_labels)
    ]
    counts = Counter[str]()
    with store.read() as connection:
        for query, of in queries:
            found = query.join(frames, frames.c.id == of.c.frame_id).where(_is_open(None, None, of))
            counts.update(dict(connection.execute(found.group_by(query.selected_columns[0])).all()))
    return {name: counts[name] for name in sorted(counts, key=lambda name: (name != OWN, name))}


def _sources(row: AnyRow) -> tuple[str, ...]:
    # most objects have none, and to read so short a text takes as long as to read the row
    further: list[tuple[float | None, str]] = json.loads(row.further) if row.further != "[]" else []
    further.sort(key=lambda each: -1.0 if each[0] is None else -each[0])
    return row.of_source or OWN, *(name for _, name in further)


def worst_of_frames(store: Store, recordings: Collection[int] | None) -> dict[int, float]:
    """The greatest doubt of the open proposals of each frame that has some, by the frame's id; 0 if it is unknown."""
    worst = func.max(func.coalesce(label_doubt(), 0.0))
    query = _of_frames(select(labels.c.frame_id, worst)).where(_is_open(recordings, None)).group_by(labels.c.frame_id)
    with store.read() as connection:
        return {row[0]: row[1] for row in connection.execute(query)}


def _of_frames(query: Select[Any], of: Table = labels) -> Select[Any]:
    return query.select_from(of).join(frames, frames.c.id == of.c.frame_id)


def _is_open(
    recordings: Collection[int] | None, classes: Collection[str] | None, of: Table = labels
) -> ColumnElement[bool]:
    is_open = (of.c.state == ReviewState.PROPOSED.value) & frames.c.position.is_not(None) & ~frames.c.finalised
    if of is still_labels:
        is_open &= of.c.id.in_(select(_OPEN_STILLS.c.id))
    if recordings is not None:
        is_open &= frames.c.recording_id.in_(recordings)
    return is_open if classes is None else is_open & of.c.label.in_(classes)


def _is_said_by(source: str, of: Table) -> ColumnElement[bool]:
    name = None if source == OWN else source
    behind = select(_BEHIND.c.behind).where(
        _BEHIND.c.behind.is_not(None), _BEHIND.c.of_source.is_not_distinct_from(name)
    )
    return of.c.of_source.is_not_distinct_from(name) | of.c.uid.in_(behind)


def label_doubt(of: Table = labels) -> ColumnElement[float]:
    """1 - product of (1 - MAX_DOUBT * share of the way from good to bad, in 0..1), over the signals with a value."""
    trust: ColumnElement[float] = literal(1.0)
    for name, (good, bad) in SIGNALS.items():
        way = (of.c[name] - good) / (bad - good)
        trust *= func.coalesce(1.0 - MAX_DOUBT * func.min(func.max(way, 0.0), 1.0), 1.0)
    # the score first: SQLite reads a row up to the last column that it needs
    unknown = and_(of.c.score.is_(None), of.c.proposed_box.is_(None))
    return case((unknown, null()), else_=cast(1.0 - trust, Float))


def _order(by: By, of: Table) -> Sequence[ColumnElement[Any]]:
    worst = -func.coalesce(label_doubt(of), 0.0)
    first: dict[By, list[ColumnElement[Any]]] = {
        By.DOUBT: [worst],
        By.FRAME: [],
        By.CLASS: [of.c.label, worst],
        By.TRACK: [frames.c.recording_id, of.c.track_id.is_(None), func.coalesce(of.c.track_id, 0)],
    }
    return [*first[by], frames.c.recording_id, frames.c.position, frames.c.id, of.c.id]
