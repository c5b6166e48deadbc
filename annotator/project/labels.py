"""3D labels of frames: their present state, and their review."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from sqlalchemy import Connection, Select, Table, and_, bindparam, case, func, or_, select, true

from annotator.project.audit.writing import Receipt, WriteContext
from annotator.project.changes import (
    LabelChanged,
    LabelDeleted,
    NewLabel,
    Origin,
)
from annotator.project.classes.attributes import AttributeOf
from annotator.project.classes.values import is_kept, labels_of_tracks
from annotator.project.database.schema import (
    ALL_LABELS,
    BOTH_LABELS,
    LABELS_OF_MOMENT,
    MOMENT,
    AnyRow,
    classes,
    frames,
    labels,
    own_labels,
    recordings,
    sightings,
    still_labels,
    stills,
)
from annotator.project.frames import StoredFrame
from annotator.project.log import Writer, new_action
from annotator.project.recordings import of_rig
from annotator.project.records import OWN, BoxRecord, storable, suggestion_of
from annotator.project.rows import Names, Place, Terms, box_2d_of, box_of, said_in, still_of, values_of
from annotator.types import Box2D, BoxKind, Label, OrientedBox, Quality, ReviewState, Source
from annotator.types.errors import NotFoundError
from annotator.types.label import AttributeValue, Said

REVIEWED = (ReviewState.ACCEPTED, ReviewState.EDITED)
# Frames between two boxes of a track that are compared; farther apart, an object may have turned.
MOST_BESIDE = 30


@dataclass(frozen=True, eq=False)
class StoredLabel:
    """A label as stored in the project.

    Attributes:
        frame_id: the frame in whose camera its box is given.
        made_in: the frame in which it was made, on whose image `image_box` lies; often the same.
        quality: the recursion's signals for the review, if it was proposed; NaN for a signal without a value.
        image_box: box on the camera image that it was drawn from, if any.
        track_linked: True if linking assigned the track id, not a person or a file.
        said: what each source says of the object, if other software proposed it; of ours, only the others.
    """

    frame_id: int
    made_in: int
    label: Label
    quality: Quality | None
    run_id: int | None
    origin: Origin | None = None
    image_box: Box2D | None = None
    track_linked: bool = False
    said: tuple[Said, ...] = ()

    @property
    def is_own(self) -> bool:
        """Whether it was made in this frame, not in that of another camera of the moment."""
        return self.made_in == self.frame_id

    @property
    def still(self) -> str | None:
        """The uid of the object that stands still and gives this label; None for a label of this moment alone."""
        return still_of(self.label.uid)


@dataclass(frozen=True)
class Created:
    """Result of `Labels.create`: the uids of the new labels, in the given order, and the receipt."""

    uids: tuple[str, ...]
    receipt: Receipt


@dataclass(frozen=True, eq=False)
class Labels:
    """Reads and reviews 3D labels.

    Every change is based on a revision of the frame. It raises StaleRevisionError if the frame has changed since,
    FinalisedFrameError if an automatic pass may not change the frame, and ProjectError for an unknown frame, label or
    class.
    """

    writer: Writer

    def of_frame(self, frame_id: int) -> tuple[Label, ...]:
        """The labels of a frame's moment in the order of their creation, rejected ones included."""
        return tuple(stored.label for stored in self.of_moment(frame_id))

    def of_moment(self, frame_id: int) -> tuple[StoredLabel, ...]:
        """As `of_frame`, with what is stored beside each."""
        with self.writer.store.read() as connection:
            return read_stored(connection, frame_id)

    def near(self, boxes: Iterable[tuple[int, OrientedBox, int | None]]) -> dict[int, tuple[StoredLabel, ...]]:
        """The labels of frames that may touch a box there, or are of its track, in the order of their creation.

        A track may have 1,000 boxes in frames of a street, so only these are made of their rows.

        Args:
            boxes: id of a frame, a box in the frame of its camera, and the track of that box, each.

        Returns:
            by the frame's id, without frames that have none.
        """
        found = defaultdict[int, dict[str, StoredLabel]](dict)
        with self.writer.store.read() as connection:
            terms, places = Terms(connection), []
            for frame_id, box, track_id in boxes:
                T = terms.T_camera_cloud(frame_id)
                center_m = box.center_m if T is None else T.inv().apply(box.center_m)
                places.append((frame_id, *center_m.tolist(), float(box.size_m.sum()) / 2, track_id))
            rows = [row for near in _NEAR for row in connection.execute(near, {"places": json.dumps(places)})]
            for each in stored_labels(connection, rows, [row.seen_from for row in rows]):
                found[each.frame_id][each.label.uid] = each
        return {frame_id: tuple(by_uid.values()) for frame_id, by_uid in found.items()}

    def drawn_on_images(self, uids: Collection[str]) -> frozenset[str]:
        """Those of some labels that have a box on a camera image."""
        with self.writer.store.read() as connection:
            return frozenset(connection.execute(_DRAWN, {"uids": json.dumps([*uids])}).scalars())

    def get(self, uid: str) -> StoredLabel:
        """One label."""
        with self.writer.store.read() as connection:
            row = connection.execute(select(labels).where(labels.c.uid == uid)).first()
            if row is None:
                raise NotFoundError(f"the project has no label {uid}; it may have been deleted")
            return stored_labels(connection, [row])[0]

    def select(
        self,
        *,
        states: Collection[ReviewState] | None = None,
        recordings: Collection[int] | None = None,
        classes: Collection[str] | None = None,
    ) -> tuple[StoredLabel, ...]:
        """Labels of the whole project, ordered by the frames in which they were made; None = no condition.

        `REVIEWED` holds accepted and edited.
        """
        # SQLite opens up the union of `labels` only if the columns of the order are among those of the result
        place = frames.c.recording_id, frames.c.position.nulls_last(), labels.c.frame_id, labels.c.id
        query = select(labels, frames.c.recording_id, frames.c.position)
        ordered = _filtered(query, labels, states, recordings, classes).order_by(*place)
        with self.writer.store.read() as connection:
            return stored_labels(connection, connection.execute(ordered).all())

    def along(
        self,
        recording_id: int,
        *,
        states: Collection[ReviewState] | None = None,
        tracks: Collection[int] | None = None,
    ) -> tuple[StoredLabel, ...]:
        """The labels of a recording's moments as its camera sees them, ordered by frame."""
        query = select(labels, frames.c.id.label("seen_from"), frames.c.position)
        query = query.join(frames, frames.c.moment_id == labels.c.moment_id)
        query = query.where(frames.c.recording_id == recording_id)
        if states is not None:
            query = query.where(labels.c.state.in_([state.value for state in states]))
        if tracks is not None:
            query = query.where(labels.c.track_id.in_(tracks))
        with self.writer.store.read() as connection:
            rows = connection.execute(query.order_by(frames.c.position.nulls_last(), frames.c.id, labels.c.id)).all()
            return stored_labels(connection, rows, [row.seen_from for row in rows])

    def beside(self, frame: StoredFrame) -> dict[int | None, OrientedBox]:
        """The box of each of a frame's tracks in the nearest frame before it, or else after it, by the track's id.

        Rejected boxes do not count, nor do those more than `MOST_BESIDE` frames away.
        """
        if frame.index is None:
            return {}
        where = {"frame": frame.id, "recording": frame.recording_id, "position": frame.index}
        where |= {"first": frame.index - MOST_BESIDE, "last": frame.index + MOST_BESIDE}
        with self.writer.store.read() as connection:
            terms = Terms(connection)
            of_both = _BESIDE[: 1 + terms.has_stills]
            rows = [row for beside in of_both for row in connection.execute(beside, where)]
            nearest = sorted(rows, key=lambda row: row.away, reverse=True)
            found = {row.track_id: (row.box, row.seen_from) for row in nearest}
            return {track_id: terms.box(*at) for track_id, at in found.items()}

    def next_track_id(self, recording_id: int) -> int:
        """1 + the highest track id of a recording's rig, at least 1."""
        query = select(func.max(ALL_LABELS.c.track_id)).join(frames, frames.c.id == ALL_LABELS.c.frame_id)
        rig = select(recordings.c.rig_id).where(recordings.c.id == recording_id).scalar_subquery()
        still = select(func.max(stills.c.track_id)).where(stills.c.rig_id == rig)
        with self.writer.store.read() as connection:
            return 1 + max(
                connection.execute(each).scalar() or 0 for each in (query.where(of_rig(recording_id)), still)
            )

    def recent(self, most: int, *, label: str | None = None, recording: int | None = None) -> tuple[StoredLabel, ...]:
        """The latest reviewed labels of whole objects (of a class, of a recording), the newest first.

        After them, one of each object that stands still.
        """
        whole = select(own_labels.c.id).where(own_labels.c.box_kind == BoxKind.BOX.value)
        if label is not None:
            whole = whole.where(own_labels.c.label == label)
        if recording is not None:
            whole = whole.join(frames, frames.c.id == own_labels.c.frame_id)
            whole = whole.where(frames.c.recording_id == recording)
        # one query for each state, so that the index gives the order
        latest = [
            whole.where(own_labels.c.state == state.value).order_by(own_labels.c.id.desc()).limit(most)
            for state in REVIEWED
        ]
        with self.writer.store.read() as connection:
            ids = sorted((id_ for query in latest for id_ in connection.execute(query).scalars()), reverse=True)[:most]
            query = select(own_labels).where(own_labels.c.id.in_(ids)).order_by(own_labels.c.id.desc())
            rows = list(connection.execute(query))
            if len(rows) < most:
                query = _first_sightings(label, recording).limit(most - len(rows))
                seen = [row.uid for row in connection.execute(query) if row.uid is not None]
                rows += (
                    connection.execute(select(still_labels).where(still_labels.c.uid.in_(seen))).all() if seen else ()
                )
            return stored_labels(connection, rows)

    def count(self, states: Collection[ReviewState] | None = None, recordings: Collection[int] | None = None) -> int:
        """Number of labels; None = no condition."""
        queries = [_filtered(select(func.count()), each, states, recordings, None) for each in BOTH_LABELS]
        with self.writer.store.read() as connection:
            return sum(int(connection.execute(query).scalar_one()) for query in queries)

    def frames(
        self, *, states: Collection[ReviewState] | None = None, recordings: Collection[int] | None = None
    ) -> frozenset[int]:
        """Ids of the frames with at least one such label."""
        queries = [_filtered(select(of.c.frame_id).distinct(), of, states, recordings, None) for of in BOTH_LABELS]
        with self.writer.store.read() as connection:
            return frozenset(id for query in queries for id in connection.execute(query).scalars())

    def create(
        self, frame_id: int, new: Sequence[NewLabel], context: WriteContext, action: str | None = None
    ) -> Created:
        """Adds labels, all or none; `context.source` distinguishes drawn labels from imported ones.

        Args:
            action: id of an action over several frames (`new_action`) that they are a part of.
        """
        receipt = self.writer.append(frame_id, new, context, action)
        return Created(tuple(each.uid for each in new), receipt)

    def accept(self, frame_id: int, uid: str, context: WriteContext) -> Receipt:
        """Accepts a label unchanged."""
        return self.writer.append(frame_id, (LabelChanged(uid=uid, state=ReviewState.ACCEPTED),), context)

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
            record = BoxRecord.of(box)
        return self.writer.append(
            frame_id,
            [LabelChanged(uid=uid, state=ReviewState.EDITED, label=label, box=record, track_id=track_id)],
            context,
        )

    def set_attributes(
        self, frame_id: int, uid: str, changed: Mapping[str, AttributeValue | None], context: WriteContext
    ) -> None:
        """Sets values of a label's attributes (None removes one); those of its track in all labels of the track.

        A proposal of which a person has set values is not replaced by automatic passes (`kept`).
        """
        # tells the label from those of its track that follow
        context = replace(context, effort_target=context.effort_target or uid)
        with self.writer.store.write() as connection:
            of_tracks = [each for each in Terms(connection).attributes if each.of is AttributeOf.TRACK]
            along = [each for each in of_tracks if each.name in changed]
            payloads = {frame_id: [LabelChanged(uid=uid, attributes=dict(changed))]}
            revisions = {frame_id: context.revision}
            track = connection.execute(select(labels.c.track_id).where(labels.c.uid == uid)).scalar()
            # an object that stands still is changed once
            known = {still_of(uid)} - {None}
            if along and track is not None:
                for row in connection.execute(labels_of_tracks(frame_id, [track])):
                    # a track whose classes differ is a mistake, but no obstacle
                    same_values = {each.name: changed[each.name] for each in along if each.is_of(row.label)}
                    is_same = row.uid == uid or still_of(row.uid) in known
                    known |= {still_of(row.uid)} - {None}
                    if not is_same and same_values:
                        revisions.setdefault(row.frame_id, row.revision)
                        same = LabelChanged(uid=row.uid, attributes=same_values)
                        payloads.setdefault(row.frame_id, []).append(same)
            action = new_action()
            for id, of_frame in payloads.items():
                context = replace(context, revision=revisions[id])
                self.writer.to_frame_in(connection, id, of_frame, context, action)
                context = replace(context, effort=None)  # counted once, on the label's frame

    def kept(self, *frame_ids: int) -> frozenset[str]:
        """Uids of proposals in frames' moments that no automatic pass replaces, as `classes.values.is_kept`."""
        with self.writer.store.read() as connection:
            rows = connection.execute(_VALUES_SET, {"ids": json.dumps(frame_ids)}).all()
            if not rows:
                return frozenset()
            terms = Terms(connection)
            return frozenset(row.uid for row in rows if is_kept(dict(row._mapping), terms))

    def reject(self, frame_id: int, uid: str, context: WriteContext) -> Receipt:
        """Rejects a label: the object does not exist, and is not proposed again."""
        return self.writer.append(frame_id, (LabelChanged(uid=uid, state=ReviewState.REJECTED),), context)

    def delete(self, frame_id: int, uid: str, context: WriteContext) -> Receipt:
        """Removes a label; the object may be proposed again."""
        return self.writer.append(frame_id, (LabelDeleted(uid=uid),), context)


# Built once, since building these frequent queries takes longer than running them.
_SHOWN = func.json_each(bindparam("uids")).table_valued("value")
_BEHIND = (
    select(ALL_LABELS)
    .where(ALL_LABELS.c.behind.is_not(None), ALL_LABELS.c.behind.in_(select(_SHOWN.c.value)))
    .order_by(ALL_LABELS.c.id)
)
# SQLite gives the other columns of the row with the minimum: frames before this one first, then the nearest
_PLACE = frames.c.position - bindparam("position")
_BESIDE = [
    select(
        of.c.track_id,
        of.c.box,
        frames.c.id.label("seen_from"),
        func.min(case((_PLACE < 0, -_PLACE), else_=_PLACE + MOST_BESIDE)).label("away"),
    )
    .join(frames, frames.c.moment_id == of.c.moment_id)
    .where(
        frames.c.recording_id == bindparam("recording"),
        frames.c.position.between(bindparam("first"), bindparam("last")),
        frames.c.id != bindparam("frame"),
        of.c.state != ReviewState.REJECTED.value,
        of.c.track_id.in_(select(labels.c.track_id).where(labels.c.moment_id == MOMENT)),
    )
    .group_by(of.c.track_id)
    for of in BOTH_LABELS
]
_IDS = func.json_each(bindparam("ids")).table_valued("value")
# a place: frame, centre, half the sum of the sides, which is more than half the diagonal, and track
_PLACES = func.json_each(bindparam("places")).table_valued("value")
_FRAME, _X, _Y, _Z, _REACH, _TRACK = (func.json_extract(_PLACES.c.value, f"$[{n}]") for n in range(6))
_CENTER, _SIZE = (
    [func.json_extract(own_labels.c.box, f"$.{name}[{axis}]") for axis in range(3)] for name in ("center_m", "size_m")
)
_IS_NEAR = (
    func.abs(own - other) <= _REACH + (_SIZE[0] + _SIZE[1] + _SIZE[2]) / 2
    for own, other in zip(_CENTER, (_X, _Y, _Z), strict=True)
)
# those that stand still, whose boxes lie in another frame of coordinates, and are few, are near in any case
_NEAR = [
    select(of, frames.c.id.label("seen_from"))
    .select_from(_PLACES)
    .join(frames, frames.c.id == _FRAME)
    .join(of, of.c.moment_id == frames.c.moment_id)
    .where(is_near)
    .order_by(of.c.id)
    for of, is_near in ((own_labels, or_(own_labels.c.track_id == _TRACK, and_(*_IS_NEAR))), (still_labels, true()))
]
_VALUES_SET = (
    select(own_labels)
    .join(frames, frames.c.moment_id == own_labels.c.moment_id)
    .where(frames.c.id.in_(select(_IDS.c.value)), own_labels.c.values_set.is_(True))
)
_DRAWN = select(own_labels.c.uid).where(
    own_labels.c.uid.in_(select(_SHOWN.c.value)), own_labels.c.image_box.is_not(None)
)


def _first_sightings(label: str | None, recording: int | None) -> Select[Any]:
    """Query for the uid of the first label of each reviewed still object, the newest object first."""
    seen = select(sightings.c.uid).where(sightings.c.still == stills.c.uid, sightings.c.seen)
    uid = seen.order_by(sightings.c.id).limit(1).scalar_subquery().label("uid")
    query = select(uid).where(stills.c.box_kind == BoxKind.BOX.value, stills.c.state.in_(REVIEWED))
    if label is not None:
        query = query.join(classes, classes.c.id == stills.c.class_id).where(classes.c.name == label)
    if recording is not None:
        rig = select(recordings.c.rig_id).where(recordings.c.id == recording).scalar_subquery()
        query = query.where(stills.c.rig_id == rig)
    return query.order_by(stills.c.time_ns.desc())


def read_stored(connection: Connection, frame_id: int) -> tuple[StoredLabel, ...]:
    """As `Labels.of_moment`, within the caller's transaction."""
    rows = connection.execute(LABELS_OF_MOMENT, {"frame": frame_id}).all()
    return stored_labels(connection, rows, [frame_id] * len(rows))


def stored_labels(
    connection: Connection, rows: Sequence[AnyRow], frame_ids: Sequence[int] | None = None
) -> tuple[StoredLabel, ...]:
    """The labels of rows; the same object for an equal row, as long as it is remembered.

    Args:
        frame_ids: as in `StoredLabel`; None = those in which they were made.
    """
    terms, behind = Terms(connection), defaultdict[str, list[AnyRow]](list)
    frame_ids = [row.frame_id for row in rows] if frame_ids is None else frame_ids
    for row in connection.execute(_BEHIND, {"uids": json.dumps([row.uid for row in rows])}):
        behind[row.behind].append(row)
    return tuple(
        _stored_label(row, tuple(behind.get(row.uid, ())), frame_id, terms.key, terms.place(frame_id))
        for row, frame_id in zip(rows, frame_ids, strict=True)
    )


def certainty(said: Said) -> tuple[float, bool]:
    """The order of what sources say of an object, the surest first; a box without a score counts as sure."""
    return -1.0 if said.score is None else -said.score, said.source == OWN


@lru_cache(maxsize=2048)
def _stored_label(row: AnyRow, behind: tuple[AnyRow, ...], frame_id: int, names: Names, place: Place) -> StoredLabel:
    label = Label(
        row.label,
        box_of(row.box, place),
        row.track_id,
        row.score,
        box_kind=BoxKind(row.box_kind),
        attributes=values_of(row.attributes),
        uid=row.uid,
        source=Source(row.source),
        state=ReviewState(row.state),
        author=row.author,
        time_ns=row.time_ns,
        expected_iou_loss=None if row.state == ReviewState.EDITED else row.expected_iou_loss,
        suggestion=suggestion_of(row.suggestion),
    )
    return StoredLabel(
        frame_id,
        row.frame_id,
        label,
        _quality(row),
        row.run_id,
        None if row.origin is None else Origin(row.origin),
        box_2d_of(row.image_box, names),
        row.track_linked,
        _said(row, behind, names, place),
    )


def _said(row: AnyRow, behind: Sequence[AnyRow], names: Names, place: Place) -> tuple[Said, ...]:
    own = [row] if row.of_source is not None else []
    return tuple(sorted((said_in(each._mapping, names, place) for each in (*own, *behind)), key=certainty))


def _quality(row: AnyRow) -> Quality | None:
    if row.proposed_box is None and row.expected_iou_loss is None:
        return None
    # SQLite stores NaN as NULL
    disagreement, kept_share, last_change = (
        float("nan") if value is None else value for value in (row.view_disagreement, row.kept_share, row.last_change)
    )
    return Quality(disagreement, kept_share, last_change, row.image_agreement, row.expected_iou_loss)


def _filtered(
    query: Select[Any],
    of: Table,
    states: Collection[ReviewState] | None,
    recordings: Collection[int] | None,
    classes: Collection[str] | None,
) -> Select[Any]:
    query = query.join_from(of, frames, frames.c.id == of.c.frame_id)
    if states is not None:
        query = query.where(of.c.state.in_([state.value for state in states]))
    if recordings is not None:
        query = query.where(frames.c.recording_id.in_(recordings))
    if classes is not None:
        query = query.where(of.c.label.in_(classes))
    return query
