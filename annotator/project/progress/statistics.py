"""Counts of a project, and the results of its review."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, FromClause, Select, distinct, func, select, union

from annotator.project.classes.attributes import Attribute
from annotator.project.classes.counts import counts_with_defaults
from annotator.project.database.schema import (
    BOTH_LABELS,
    AnyRow,
    events,
    frame_results,
    frames,
    image_labels,
    models,
    recordings,
    runs,
    view_labels,
)
from annotator.project.database.schema import (
    own_labels as labels,
)
from annotator.project.database.store import Store
from annotator.project.jobs import Status, latest_results
from annotator.project.labels import REVIEWED
from annotator.project.progress.report import Review, ReviewReader
from annotator.project.recordings import KEPT
from annotator.types import BoxKind, ReviewState, Source
from annotator.types.bases import Strict


class LabelCounts(Strict):
    """Counts of 3D labels; every state, source and kind of box is a key, even with count 0."""

    total: int
    by_state: dict[ReviewState, int]
    by_class: dict[str, int]
    by_class_and_state: dict[str, dict[ReviewState, int]]
    by_source: dict[Source, int]
    by_kind: dict[BoxKind, int]


class SuggestedCounts(Strict):
    """Counts of the accepted and edited labels whose boxes a view detector suggested while they were drawn.

    Attributes:
        as_suggested: the operator accepted all boxes, and nobody has changed the 3D box since.
    """

    as_suggested: int
    corrected: int


class BoxCounts(Strict):
    """Counts of 2D boxes and of the labelled images (`pictures`), images labelled as empty included."""

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
    in_frames = [select(of.c.frame_id) for of in BOTH_LABELS]
    proposed = labels.c.state == ReviewState.PROPOSED.value
    failed = (frame_results.c.status == Status.FAILED.value) & frame_results.c.id.in_(latest_results())
    failed &= frame_results.c.frame_id.in_(select(frames.c.id).where(KEPT))
    with store.read() as connection:
        values, without = counts_with_defaults(connection, attributes)
        return Statistics(
            recordings=_number(connection, select(func.count()).where(recordings.c.removed_ns.is_(None))),
            frames=_number(connection, present),
            frames_finalised=_number(connection, present.where(frames.c.finalised.is_(True))),
            frames_with_labels=_number(connection, select(func.count()).select_from(union(*in_frames).subquery())),
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


def _label_counts(connection: Connection) -> LabelCounts:
    rows = list[AnyRow]()
    for of in BOTH_LABELS:
        columns = [of.c[name] for name in ("label", "state", "source", "box_kind")]
        rows += connection.execute(select(*columns, func.count()).group_by(*columns).order_by(of.c.label))
    by_class, states = dict[str, int](), dict[str, dict[ReviewState, int]]()
    of_state, of_source, of_kind = dict.fromkeys(ReviewState, 0), dict.fromkeys(Source, 0), dict.fromkeys(BoxKind, 0)
    for name, state, source, kind, number in rows:
        by_class[name] = by_class.get(name, 0) + number
        states.setdefault(name, dict.fromkeys(ReviewState, 0))[ReviewState(state)] += number
        of_state[state] += number
        of_source[source] += number
        of_kind[kind] += number
    return LabelCounts(
        total=sum(of_state.values()),
        by_state=of_state,
        by_class=by_class,
        by_class_and_state=states,
        by_source=of_source,
        by_kind=of_kind,
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


def _box_counts(connection: Connection, table: FromClause) -> BoxCounts:
    query = select(table.c.source, func.sum(table.c["count"])).group_by(table.c.source)
    by_source = dict.fromkeys(Source, 0) | {Source(of): int(sum_) for of, sum_ in connection.execute(query)}
    return BoxCounts(pictures=_rows(connection, table), boxes=sum(by_source.values()), boxes_by_source=by_source)
