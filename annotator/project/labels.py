"""3D boxes of frames in their present state, and their review."""

from __future__ import annotations

import uuid
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Select, select

from annotator.project.payloads import LabelAccepted, LabelCreated, LabelDeleted, LabelEdited, LabelRejected, Origin
from annotator.project.records import BoxRecord, box_2d_of, storable
from annotator.project.schema import AnyRow, frames, labels
from annotator.project.writing import Change, Receipt, Writer
from annotator.types import Box2D, Label, OrientedBox, Quality, ReviewState, Source
from annotator.types.errors import NotFoundError, ProjectError
from annotator.types.tracks import MOST_TRACK

REVIEWED = (ReviewState.ACCEPTED, ReviewState.EDITED)
QUALITY = ("view_disagreement", "kept_share", "last_change", "image_agreement")


@dataclass(frozen=True, eq=False)
class NewLabel:
    """A 3D box that no automatic pass proposed.

    Attributes:
        label: class name.
        box: camera frame.
        score: detector confidence in 0..1, where it has one.
        track_id: the object's id over the recording, where known.
        state: anything but PROPOSED, which the next automatic pass would remove.
        origin: how an operator made it, where one did.

    Raises ProjectError for a track id beyond `MOST_TRACK`.
    """

    label: str
    box: OrientedBox
    score: float | None = None
    track_id: int | None = None
    state: ReviewState = ReviewState.ACCEPTED
    origin: Origin | None = None

    def __post_init__(self) -> None:
        # the database would not take it, or a file would not give it back
        if self.track_id is not None and abs(self.track_id) > MOST_TRACK:
            raise ProjectError(f"a track id goes from -{MOST_TRACK} to {MOST_TRACK}; number the tracks anew")


@dataclass(frozen=True, eq=False)
class StoredLabel:
    """A label with its place in the project.

    Attributes:
        frame_id: its frame.
        label: the label itself.
        quality: the recursion's signals for the review, where it was proposed; a signal that had no value is NaN.
        run_id: of the batch run that proposed it, where one did.
        origin: how an operator made it, where one did.
        image_box: on the camera image, where it was drawn from one.
        track_linked: True where linking gave the track id, and no person or file.
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
    """What a label is sorted by: a `StoredLabel` without its box, whose reading takes most of the time.

    Attributes:
        frame_id, quality: as of `StoredLabel`.
        uid, label, score, track_id: as of `Label`.
    """

    frame_id: int
    uid: str
    label: str
    score: float | None
    quality: Quality | None
    track_id: int | None = None


@dataclass(frozen=True)
class Created:
    """The uids of new labels, in the order given, and the receipt."""

    uids: tuple[str, ...]
    receipt: Receipt


@dataclass(frozen=True, eq=False)
class Labels:
    """Reads and reviews 3D labels.

    Every change names the revision of the frame that it is based on, and raises StaleRevisionError where the frame
    has changed since, FinalisedFrameError where an automatic pass wants to change a finalised frame, and ProjectError
    for a frame, label or class that the project does not have.
    """

    writer: Writer

    def of_frame(self, frame_id: int) -> tuple[Label, ...]:
        """The labels of one frame in the order they were made, rejected ones included."""
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
            raise NotFoundError(f"the project has no label {uid} (any more)")
        return stored_label(row)

    def select(
        self,
        *,
        states: Collection[ReviewState] | None = None,
        recordings: Collection[int] | None = None,
        classes: Collection[str] | None = None,
        tracks: Collection[int] | None = None,
    ) -> tuple[StoredLabel, ...]:
        """Labels of the whole project, frame by frame; None = no condition. `REVIEWED` names the trustworthy states."""
        chosen = _chosen(select(labels), states, recordings, classes)
        ordered = _in_order(chosen if tracks is None else chosen.where(labels.c.track_id.in_(tracks)))
        with self.writer.store.read() as connection:
            return tuple(map(stored_label, connection.execute(ordered)))

    def signals(
        self,
        *,
        states: Collection[ReviewState] | None = None,
        recordings: Collection[int] | None = None,
        classes: Collection[str] | None = None,
    ) -> tuple[LabelSignals, ...]:
        """The same labels as `select` gives, in the same order, without their boxes."""
        names = ("frame_id", "uid", "label", "score", "track_id", "proposal_event_id", *QUALITY)
        ordered = _in_order(_chosen(select(*(labels.c[name] for name in names)), states, recordings, classes))
        with self.writer.store.read() as connection:
            return tuple(
                LabelSignals(row.frame_id, row.uid, row.label, row.score, _quality(row), row.track_id)
                for row in connection.execute(ordered)
            )

    def frames(
        self, *, states: Collection[ReviewState] | None = None, recordings: Collection[int] | None = None
    ) -> frozenset[int]:
        """Ids of the frames that have such labels."""
        query = _chosen(select(labels.c.frame_id).distinct(), states, recordings, None)
        with self.writer.store.read() as connection:
            return frozenset(connection.execute(query).scalars())

    def create(self, frame_id: int, new: Sequence[NewLabel], change: Change) -> Created:
        """Add labels, all or none; `change.source` says whether a person drew them or a file brought them."""
        with storable("a label"):
            payloads = [_created(entry) for entry in new]
        receipt = self.writer.to_frame(frame_id, payloads, change)
        return Created(tuple(payload.uid for payload in payloads), receipt)

    def accept(self, frame_id: int, uid: str, change: Change) -> Receipt:
        """The label is right as it stands."""
        return self.writer.to_frame(frame_id, (LabelAccepted(uid=uid),), change)

    def edit(
        self, frame_id: int, uid: str, change: Change, *, label: str, box: OrientedBox, track_id: int | None = None
    ) -> Receipt:
        """Give a label its new class, box and track."""
        with storable(f"label {uid}"):
            payload = LabelEdited(uid=uid, label=label, box=BoxRecord.of(box), track_id=track_id)
        return self.writer.to_frame(frame_id, (payload,), change)

    def reject(self, frame_id: int, uid: str, change: Change) -> Receipt:
        """There is no such object; it is not proposed again."""
        return self.writer.to_frame(frame_id, (LabelRejected(uid=uid),), change)

    def delete(self, frame_id: int, uid: str, change: Change) -> Receipt:
        """Take a label away; the object may be proposed again."""
        return self.writer.to_frame(frame_id, (LabelDeleted(uid=uid),), change)


def _created(entry: NewLabel) -> LabelCreated:
    return LabelCreated(
        uid=uuid.uuid4().hex,
        label=entry.label,
        box=BoxRecord.of(entry.box),
        score=entry.score,
        track_id=entry.track_id,
        state=entry.state,
        origin=entry.origin,
    )


def read_labels(connection: Connection, frame_id: int) -> tuple[Label, ...]:
    """The labels of one frame, within the caller's transaction."""
    query = select(labels).where(labels.c.frame_id == frame_id).order_by(labels.c.id)
    return tuple(map(_label, connection.execute(query)))


def _label(row: AnyRow) -> Label:
    return Label(
        row.uid,
        row.label,
        BoxRecord.model_validate_json(row.box).box(),
        row.score,
        Source(row.source),
        ReviewState(row.state),
        row.author,
        row.time_ns,
        row.track_id,
    )


def stored_label(row: AnyRow) -> StoredLabel:
    """The label that a row of the table holds, with its place in the project."""
    origin = None if row.origin is None else Origin(row.origin)
    image_box = box_2d_of(row.image_box)
    return StoredLabel(row.frame_id, _label(row), _quality(row), row.run_id, origin, image_box, row.track_linked)


def _quality(row: AnyRow) -> Quality | None:
    if row.proposal_event_id is None:
        return None
    # SQLite keeps NaN as NULL
    disagreement, kept, change = (
        float("nan") if value is None else value for value in (row.view_disagreement, row.kept_share, row.last_change)
    )
    return Quality(disagreement, kept, change, row.image_agreement)


def _chosen(
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
