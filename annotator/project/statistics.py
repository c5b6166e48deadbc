"""Counts of a project, and the results of its review."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict
from sqlalchemy import Connection, FromClause, Select, distinct, func, select

from annotator.project.classes.attributes import Attribute
from annotator.project.classes.counts import counts_with_defaults
from annotator.project.database.schema import (
    events,
    frame_results,
    frames,
    image_labels,
    labels,
    models,
    recordings,
    runs,
    view_labels,
)
from annotator.project.database.store import Store
from annotator.project.jobs import Status, latest_results
from annotator.project.labels import REVIEWED
from annotator.project.progress.report import Review, ReviewReader
from annotator.project.recordings import KEPT
from annotator.types import BoxKind, ReviewState, Source


class LabelCounts(BaseModel):
    """Counts of 3D labels; every state, source and kind of box is a key, even with count 0."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    total: int
    by_state: dict[ReviewState, int]
    by_class: dict[str, int]
    by_class_and_state: dict[str, dict[ReviewState, int]]
    by_source: dict[Source, int]
    by_kind: dict[BoxKind, int]


class SuggestedCounts(BaseModel):
    """Counts of the accepted and edited labels whose boxes a view detector suggested while they were drawn.

    Attributes:
        as_suggested: the operator accepted all boxes, and nobody has changed the 3D box since.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    as_suggested: int
    corrected: int


class BoxCounts(BaseModel):
    """Counts of 2D boxes and of the labelled images (`pictures`), images labelled as empty included."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    pictures: int
    boxes: int
    boxes_by_source: dict[Source, int]


class Statistics(Review):
    """Counts of one project at one moment.

    Attributes:
        frames: found by the latest scans.
        frames_failed: with a failed latest automatic pass.
        attributes: by name, then by value: labels that are not rejected, and frames, with that value. Frames without
            a value of their own have the default.
        without_value: by name of an attribute: the labels or frames that could have a value, but have none.
    """

    recordings: int
    frames: int
    frames_finalised: int
    frames_with_labels: int
    frames_with_proposals: int
    frames_failed: int
    labels: LabelCounts
    suggested: dict[str, SuggestedCounts]
    image_boxes: BoxCounts
    view_boxes: BoxCounts
    events: int
    runs: int
    models: int
    attributes: dict[str, dict[str, int]]
    without_value: dict[str, int]


def read_statistics(store: Store, reader: ReviewReader, attributes: Sequence[Attribute]) -> Statistics:
    """Counts everything, within one transaction; the reader keeps what takes long to compute."""
    present = select(func.count()).where(frames.c.position.is_not(None))
    proposed = labels.c.state == ReviewState.PROPOSED.value
    failed = (frame_results.c.status == Status.FAILED.value) & frame_results.c.id.in_(latest_results())
    failed &= frame_results.c.frame_id.in_(select(frames.c.id).where(KEPT))
    with store.read() as connection:
        values, without = counts_with_defaults(connection, attributes)
        return Statistics(
            recordings=_number(connection, select(func.count()).where(recordings.c.removed_ns.is_(None))),
            frames=_number(connection, present),
            frames_finalised=_number(connection, present.where(frames.c.finalised.is_(True))),
            frames_with_labels=_number(connection, select(func.count(distinct(labels.c.frame_id)))),
            frames_with_proposals=_number(connection, select(func.count(distinct(labels.c.frame_id))).where(proposed)),
            frames_failed=_number(connection, select(func.count()).where(failed)),
            labels=_label_counts(connection),
            suggested=_suggested_counts(connection),
            image_boxes=_box_counts(connection, image_labels),
            view_boxes=_box_counts(connection, view_labels),
            events=_rows(connection, events),
            runs=_rows(connection, runs),
            models=_rows(connection, models),
            attributes=values,
            without_value=without,
            **dict(reader.read(connection)),
        )


def _number(connection: Connection, query: Select[Any]) -> int:
    return int(connection.execute(query).scalar_one())


def _rows(connection: Connection, table: FromClause) -> int:
    return _number(connection, select(func.count()).select_from(table))


def _grouped(connection: Connection, table: FromClause, column: str, number: Any) -> dict[str, int]:
    query = select(table.c[column], number).group_by(table.c[column]).order_by(table.c[column])
    return {str(row[0]): int(row[1]) for row in connection.execute(query)}


def _by_source(counts: dict[str, int]) -> dict[Source, int]:
    return {source: counts.get(source.value, 0) for source in Source}


def _label_counts(connection: Connection) -> LabelCounts:
    states = _grouped(connection, labels, "state", func.count())
    kinds = _grouped(connection, labels, "box_kind", func.count())
    return LabelCounts(
        total=_rows(connection, labels),
        by_state={state: states.get(state.value, 0) for state in ReviewState},
        by_class=_grouped(connection, labels, "label", func.count()),
        by_class_and_state=_class_and_state(connection),
        by_source=_by_source(_grouped(connection, labels, "source", func.count())),
        by_kind={kind: kinds.get(kind.value, 0) for kind in BoxKind},
    )


def _suggested_counts(connection: Connection) -> dict[str, SuggestedCounts]:
    detector = func.json_extract(labels.c.suggestion, "$.detector")
    corrected = func.sum(func.json_extract(labels.c.suggestion, "$.corrected"))
    reviewed = labels.c.suggestion.is_not(None) & labels.c.state.in_([state.value for state in REVIEWED])
    query = select(detector, corrected, func.count()).where(reviewed).group_by(detector).order_by(detector)
    return {
        name: SuggestedCounts(as_suggested=total - changed, corrected=changed)
        for name, changed, total in connection.execute(query)
    }


def _class_and_state(connection: Connection) -> dict[str, dict[ReviewState, int]]:
    query = select(labels.c.label, labels.c.state, func.count()).group_by(labels.c.label, labels.c.state)
    counts: dict[str, dict[ReviewState, int]] = {}
    for name, state, number in connection.execute(query.order_by(labels.c.label)):
        counts.setdefault(name, dict.fromkeys(ReviewState, 0))[ReviewState(state)] = int(number)
    return counts


def _box_counts(connection: Connection, table: FromClause) -> BoxCounts:
    by_source = _by_source(_grouped(connection, table, "source", func.sum(table.c["count"])))
    return BoxCounts(pictures=_rows(connection, table), boxes=sum(by_source.values()), boxes_by_source=by_source)
