"""3D labels of frames: their present state, and their review."""

from __future__ import annotations

import uuid
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Select, func, select

from annotator.project.event_types import LabelAccepted, LabelCreated, LabelDeleted, LabelEdited, LabelRejected, Origin
from annotator.project.records import BoxRecord, box_2d_of, parsed, storable, suggestion_of
from annotator.project.schema import AnyRow, frames, labels
from annotator.project.writing import Receipt, WriteContext, Writer
from annotator.types import Box2D, BoxKind, Label, OrientedBox, Quality, ReviewState, Source, Suggestion
from annotator.types.errors import NotFoundError, ProjectError
from annotator.types.label import MOST_TRACK

REVIEWED = (ReviewState.ACCEPTED, ReviewState.EDITED)
QUALITY = ("view_disagreement", "kept_share", "last_change", "image_agreement", "expected_iou_loss")


@dataclass(frozen=True, eq=False)
class NewLabel:
    """A 3D box not proposed by an automatic pass.

    Attributes:
        label: class name.
        box: camera frame.
        score: detector confidence in 0..1, if any.
        track_id: the object's id over the recording, if known.
        state: any but PROPOSED, which the next automatic pass would remove.
        origin: how an operator made it, if one did.
        suggestion: as in `Label`.
        image_box: box on the camera image that it was drawn from, if any.
        box_kind: what the box encloses.

    Raises ProjectError for a track id beyond `MOST_TRACK`.
    """

    label: str
    box: OrientedBox
    score: float | None = None
    track_id: int | None = None
    state: ReviewState = ReviewState.ACCEPTED
    origin: Origin | None = None
    suggestion: Suggestion | None = None
    image_box: Box2D | None = None
    box_kind: BoxKind = BoxKind.BOX

    def __post_init__(self) -> None:
        # the limit of the database and of exported files
        if self.track_id is not None and abs(self.track_id) > MOST_TRACK:
            raise ProjectError(f"a track id must lie in -{MOST_TRACK}..{MOST_TRACK}; renumber the tracks")


@dataclass(frozen=True, eq=False)
class StoredLabel:
    """A label as stored in the project.

    Attributes:
        frame_id: its frame.
        label: the label itself.
        quality: the recursion's signals for the review, if it was proposed; NaN for a signal without a value.
        run_id: of the batch run that proposed it, if one did.
        origin: how an operator made it, if one did.
        image_box: box on the camera image that it was drawn from, if any.
        track_linked: True if linking assigned the track id, not a person or a file.
    """

    frame_id: int
    label: Label
    quality: Quality | None
    run_id: int | None
    origin: Origin | None = None
    image_box: Box2D | None = None
    track_linked: bool = False


@dataclass(frozen=True)
class LabelSignals:
    """The sort keys of a label: a `StoredLabel` without its box, which takes most of the reading time.

    Attributes:
        frame_id, quality: as in `StoredLabel`.
        uid, label, score, track_id: as in `Label`.
    """

    frame_id: int
    uid: str
    label: str
    score: float | None
    quality: Quality | None
    track_id: int | None = None


@dataclass(frozen=True)
class Created:
    """Result of `Labels.create`: the uids of the new labels, in the given order, and the receipt."""

    uids: tuple[str, ...]
    receipt: Receipt


@dataclass(frozen=True, eq=False)
class ReviewedBox:
    """A reviewed 3D box, with its frame, recording, and track if known."""

    box: OrientedBox
    frame_id: int
    recording_id: int
    track_id: int | None


@dataclass(frozen=True, eq=False)
class Labels:
    """Reads and reviews 3D labels.

    Every change is based on a revision of the frame. It raises StaleRevisionError if the frame has changed since,
    FinalisedFrameError if an automatic pass may not change the frame, and ProjectError for an unknown frame, label or
    class.
    """

    writer: Writer

    def of_frame(self, frame_id: int) -> tuple[Label, ...]:
        """The labels of one frame in the order of their creation, rejected ones included."""
        with self.writer.store.read() as connection:
            return read_labels(connection, frame_id)

    def get(self, uid: str) -> StoredLabel:
        """One label.

        Raises:
            NotFoundError: no such label.
        """
        with self.writer.store.read() as connection:
            row = connection.execute(select(labels).where(labels.c.uid == uid)).first()
        if row is None:
            raise NotFoundError(f"the project has no label {uid}; it may have been deleted")
        return stored_label(row)

    def select(
        self,
        *,
        states: Collection[ReviewState] | None = None,
        recordings: Collection[int] | None = None,
        classes: Collection[str] | None = None,
        tracks: Collection[int] | None = None,
    ) -> tuple[StoredLabel, ...]:
        """Labels of the whole project, ordered by frame; None = no condition. `REVIEWED` holds accepted and edited."""
        query = _filtered(select(labels), states, recordings, classes)
        ordered = _in_order(query if tracks is None else query.where(labels.c.track_id.in_(tracks)))
        with self.writer.store.read() as connection:
            return tuple(map(stored_label, connection.execute(ordered)))

    def recent_boxes(self, label: str, most: int) -> tuple[ReviewedBox, ...]:
        """The latest reviewed boxes of a class that enclose whole objects, the newest first."""
        of_class = select(labels.c.id).where(labels.c.label == label, labels.c.box_kind == BoxKind.BOX.value)
        # one query for each state, so that the index gives the order
        latest = [
            of_class.where(labels.c.state == state.value).order_by(labels.c.id.desc()).limit(most) for state in REVIEWED
        ]
        with self.writer.store.read() as connection:
            ids = sorted((id_ for query in latest for id_ in connection.execute(query).scalars()), reverse=True)[:most]
            query = select(labels.c.box, labels.c.frame_id, frames.c.recording_id, labels.c.track_id)
            query = query.join_from(labels, frames, frames.c.id == labels.c.frame_id).where(labels.c.id.in_(ids))
            rows = connection.execute(query.order_by(labels.c.id.desc())).all()
        return tuple(
            ReviewedBox(
                parsed(BoxRecord.model_validate_json, row.box).box(), row.frame_id, row.recording_id, row.track_id
            )
            for row in rows
        )

    def count(self, states: Collection[ReviewState]) -> int:
        """Number of labels in one of these states."""
        query = select(func.count()).select_from(labels).where(labels.c.state.in_([state.value for state in states]))
        with self.writer.store.read() as connection:
            return int(connection.execute(query).scalar_one())

    def signals(
        self,
        *,
        states: Collection[ReviewState] | None = None,
        recordings: Collection[int] | None = None,
        classes: Collection[str] | None = None,
    ) -> tuple[LabelSignals, ...]:
        """The same labels as `select`, in the same order, without their boxes."""
        names = ("frame_id", "uid", "label", "score", "track_id", "proposal_event_id", *QUALITY)
        ordered = _in_order(_filtered(select(*(labels.c[name] for name in names)), states, recordings, classes))
        with self.writer.store.read() as connection:
            return tuple(
                LabelSignals(row.frame_id, row.uid, row.label, row.score, _quality(row), row.track_id)
                for row in connection.execute(ordered)
            )

    def frames(
        self, *, states: Collection[ReviewState] | None = None, recordings: Collection[int] | None = None
    ) -> frozenset[int]:
        """Ids of the frames with at least one such label."""
        query = _filtered(select(labels.c.frame_id).distinct(), states, recordings, None)
        with self.writer.store.read() as connection:
            return frozenset(connection.execute(query).scalars())

    def create(self, frame_id: int, new: Sequence[NewLabel], context: WriteContext) -> Created:
        """Adds labels, all or none; `context.source` distinguishes drawn labels from imported ones."""
        with storable("a label"):
            payloads = [_created(entry) for entry in new]
        receipt = self.writer.to_frame(frame_id, payloads, context)
        return Created(tuple(payload.uid for payload in payloads), receipt)

    def accept(self, frame_id: int, uid: str, context: WriteContext) -> Receipt:
        """Accepts a label unchanged."""
        return self.writer.to_frame(frame_id, (LabelAccepted(uid=uid),), context)

    def edit(
        self,
        frame_id: int,
        uid: str,
        context: WriteContext,
        *,
        label: str,
        box: OrientedBox,
        track_id: int | None = None,
    ) -> Receipt:
        """Changes a label's class, box and track."""
        with storable(f"label {uid}"):
            payload = LabelEdited(uid=uid, label=label, box=BoxRecord.of(box), track_id=track_id)
        return self.writer.to_frame(frame_id, (payload,), context)

    def reject(self, frame_id: int, uid: str, context: WriteContext) -> Receipt:
        """Rejects a label: the object does not exist, and is not proposed again."""
        return self.writer.to_frame(frame_id, (LabelRejected(uid=uid),), context)

    def delete(self, frame_id: int, uid: str, context: WriteContext) -> Receipt:
        """Removes a label; the object may be proposed again."""
        return self.writer.to_frame(frame_id, (LabelDeleted(uid=uid),), context)


def _created(entry: NewLabel) -> LabelCreated:
    return LabelCreated(
        uid=uuid.uuid4().hex,
        label=entry.label,
        box=BoxRecord.of(entry.box),
        score=entry.score,
        track_id=entry.track_id,
        state=entry.state,
        origin=entry.origin,
        suggestion=entry.suggestion,
        image_box=entry.image_box,
        box_kind=entry.box_kind,
    )


def read_labels(connection: Connection, frame_id: int) -> tuple[Label, ...]:
    """The labels of one frame, within the caller's transaction."""
    query = select(labels).where(labels.c.frame_id == frame_id).order_by(labels.c.id)
    return tuple(map(_label, connection.execute(query)))


def _label(row: AnyRow) -> Label:
    return Label(
        row.uid,
        row.label,
        parsed(BoxRecord.model_validate_json, row.box).box(),
        row.score,
        Source(row.source),
        ReviewState(row.state),
        row.author,
        row.time_ns,
        row.track_id,
        None if row.state == ReviewState.EDITED else row.expected_iou_loss,
        suggestion_of(row.suggestion),
        BoxKind(row.box_kind),
    )


def stored_label(row: AnyRow) -> StoredLabel:
    """The label of a table row."""
    origin = None if row.origin is None else Origin(row.origin)
    image_box = box_2d_of(row.image_box)
    return StoredLabel(row.frame_id, _label(row), _quality(row), row.run_id, origin, image_box, row.track_linked)


def _quality(row: AnyRow) -> Quality | None:
    if row.proposal_event_id is None:
        return None
    # SQLite stores NaN as NULL
    disagreement, kept_share, last_change = (
        float("nan") if value is None else value for value in (row.view_disagreement, row.kept_share, row.last_change)
    )
    return Quality(disagreement, kept_share, last_change, row.image_agreement, row.expected_iou_loss)


def _filtered(
    query: Select[Any],
    states: Collection[ReviewState] | None,
    recordings: Collection[int] | None,
    classes: Collection[str] | None,
) -> Select[Any]:
    query = query.join_from(labels, frames, frames.c.id == labels.c.frame_id)
    if states is not None:
        query = query.where(labels.c.state.in_([state.value for state in states]))
    if recordings is not None:
        query = query.where(frames.c.recording_id.in_(recordings))
    if classes is not None:
        query = query.where(labels.c.label.in_(classes))
    return query


def _in_order(query: Select[Any]) -> Select[Any]:
    return query.order_by(frames.c.recording_id, frames.c.position.nulls_last(), frames.c.id, labels.c.id)
