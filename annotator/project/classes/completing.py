"""Completes events with values of attributes that follow from the schema: defaults, and values of the label's track."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import Connection, Select, select

from annotator.project.classes.applying import frame_values, values_of
from annotator.project.classes.attributes import MEASURED, Attribute, AttributeOf, fitting
from annotator.project.event_types import (
    FrameAttributesSet,
    LabelAttributesSet,
    LabelCreated,
    LabelEdited,
    LabelProposed,
    LabelTracked,
    OwnProposal,
    Payload,
    ProposalsImported,
    ProposalsReplaced,
)
from annotator.project.records import SaidRecord, said_of, track_of
from annotator.project.schema import LABEL_OF_UID, AnyRow, frames, labels
from annotator.project.sources.lending import borrowed, lend
from annotator.types import ReviewState
from annotator.types.errors import NotFoundError, ProjectError
from annotator.types.label import AttributeValue
from annotator.types.messages import alternatives

Values = dict[str, AttributeValue]


def completed(
    connection: Connection, attributes: Sequence[Attribute], frame_id: int | None, payload: Payload
) -> Payload:
    """The event with all its values.

    Args:
        attributes: of the project.

    Raises:
        ProjectError: a value is not one of its attribute, or the label's class does not have the attribute.
    """
    match payload:
        case FrameAttributesSet():
            of_frames = [each for each in attributes if each.of is AttributeOf.FRAME]
            # values that stay as they are may be older than the schema
            present = frame_values(connection, frame_id)
            new = {key: value for key, value in payload.attributes.items() if not _is_same(value, present.get(key))}
            checked = _checked(of_frames, new, "a frame")
            return payload.model_copy(update={"attributes": payload.attributes | checked})
        case LabelAttributesSet():
            name = _present(connection, payload.uid).label
            new = {key: value for key, value in payload.attributes.items() if value is not None}
            checked = _checked([each for each in attributes if each.is_of(name)], new, name)
            return payload.model_copy(update={"attributes": payload.attributes | checked})
        case LabelCreated() | LabelProposed():
            of_label = [each for each in attributes if each.is_of(payload.label)]
            given: Values
            if isinstance(payload, LabelProposed):
                given = fitting(of_label, payload.attributes)
            else:
                given = _checked(of_label, payload.attributes, payload.label)
            of_track = _of_tracks(connection, attributes, frame_id, [payload.track_id])
            values = _new_values(of_label, of_track.get(payload.track_id, {}), given)
            return payload.model_copy(update={"attributes": values})
        case ProposalsReplaced() if attributes:
            tracks = _of_tracks(connection, attributes, frame_id, [entry.track_id for entry in payload.objects])
            objects = tuple(
                entry
                if entry.covered_by is not None
                else entry.model_copy(
                    update={
                        "attributes": _new_values(
                            [each for each in attributes if each.is_of(entry.proposal.label)],
                            tracks.get(entry.track_id, {}),
                            {},
                        )
                    }
                )
                for entry in payload.objects
            )
            return payload.model_copy(update={"objects": objects})
        case ProposalsImported() if attributes:
            return _with_lent(connection, attributes, frame_id, payload)
        case LabelEdited() | LabelTracked() if attributes:
            return payload.model_copy(update={"attributes": _after_edit(connection, attributes, frame_id, payload)})
    return payload


def restored(
    connection: Connection, attributes: Sequence[Attribute], frame_id: int | None, payload: Payload
) -> Payload:
    """An event of an undo: proposals that it shows again have no values that the schema no longer allows.

    Other states that undo restores are without these already (`undo_state.AllowedValues`).
    """
    if not isinstance(payload, ProposalsImported):
        return payload
    return _with_lent(connection, attributes, frame_id, payload)


def _with_lent(
    connection: Connection, attributes: Sequence[Attribute], frame_id: int | None, payload: ProposalsImported
) -> ProposalsImported:
    """The event with the values of each object: what its sources gave, else those of its track, else the defaults."""
    ids = [track_of(group) for group in payload.objects]
    own_rows = select(labels.c.uid, labels.c.label, labels.c.track_id)
    rows = {
        row.uid: row
        for row in connection.execute(own_rows.where(labels.c.uid.in_([each.uid for each in payload.ours]))).all()
    }
    tracks = _of_tracks(connection, attributes, frame_id, [*ids, *(row.track_id for row in rows.values())])
    groups, ours = list[tuple[SaidRecord, ...]](), list[OwnProposal]()
    for (shown, *others), track_id in zip(payload.objects, ids, strict=True):
        of_label = [each for each in attributes if each.is_of(shown.label)]
        lent = lend(of_label, shown.attributes, others)
        values = _new_values(of_label, tracks.get(track_id, {}), lent.values)
        groups.append((shown.model_copy(update={"attributes": values, "lent": ()}), *lent.others))
    for own in payload.ours:
        if own.attributes is not None and (row := rows.get(own.uid)) is not None:
            of_label = [each for each in attributes if each.is_of(row.label)]
            lent = lend(of_label, own.attributes, own.said)
            values = _new_values(of_label, tracks.get(row.track_id, {}), lent.values)
            own = own.model_copy(update={"attributes": values, "said": lent.others})
        ours.append(own)
    return payload.model_copy(update={"objects": tuple(groups), "ours": tuple(ours)})


class ValueReader:
    """Reads values of files that a project's attributes can hold.

    Attributes:
        left_out: how many values were left out, by attribute, with the reason in brackets.
    """

    def __init__(self, attributes: Sequence[Attribute]) -> None:
        self._attributes = {each.name: each for each in attributes}
        self.left_out: Counter[str] = Counter()

    def of_label(self, label: str, values: Mapping[str, AttributeValue]) -> Values:
        """The values of a box."""
        return self._read(values, {name for name, each in self._attributes.items() if each.is_of(label)})

    def of_frame(self, values: Mapping[str, AttributeValue]) -> Values:
        """The values of a frame."""
        return self._read(values, {name for name, each in self._attributes.items() if each.of is AttributeOf.FRAME})

    def _read(self, values: Mapping[str, AttributeValue], names: Collection[str]) -> Values:
        read: Values = {}
        for name, value in values.items():
            if name not in names:
                again = "; exports measure it" if name in MEASURED else ""
                self.left_out[f"{name} (not an attribute of the project{again})"] += 1
                continue
            try:
                read[name] = self._attributes[name].read(value)
            except ValueError as error:
                self.left_out[str(error)] += 1
        return read


def _after_edit(
    connection: Connection, attributes: Sequence[Attribute], frame_id: int | None, payload: LabelEdited | LabelTracked
) -> dict[str, AttributeValue | None]:
    """What changes with the class and the track of a label."""
    row = connection.execute(LABEL_OF_UID, {"uid": payload.uid}).first()
    if row is None:  # applying the event reports it
        return {}
    present, name = values_of(row.attributes), row.label
    changed: dict[str, AttributeValue | None] = {}
    if isinstance(payload, LabelEdited) and payload.label != name:
        name = payload.label
        changed = {each.name: None for each in attributes if each.name in present and not each.is_of(name)}
        missing = [each for each in attributes if each.is_of(name) and each.name not in present]
        changed |= {each.name: each.default for each in missing if each.default is not None}
    if payload.track_id != row.track_id:
        of_track = _of_tracks(connection, attributes, frame_id, [payload.track_id]).get(payload.track_id, {})
        for each in attributes:
            if each.is_of(name) and each.name in of_track and present.get(each.name) != of_track[each.name]:
                changed[each.name] = of_track[each.name]
    return changed


def _new_values(of_label: Iterable[Attribute], of_track: Mapping[str, AttributeValue], given: Values) -> Values:
    """Values of a new label: those given, else those of its track, else the defaults."""
    values: Values = {}
    for each in of_label:
        value = given.get(each.name, of_track.get(each.name, each.default))
        if value is not None:
            values[each.name] = each.checked(value)
    return values


def _checked(attributes: Iterable[Attribute], values: Mapping[str, AttributeValue], what: str) -> Values:
    known = {each.name: each for each in attributes}
    if unknown := sorted(values.keys() - known.keys()):
        raise ProjectError(
            f"{what} has no attribute {unknown[0]!r} ({alternatives(unknown[0], known)}); "
            "`annotator classes attribute` adds one"
        )
    try:
        return {name: known[name].checked(value) for name, value in values.items()}
    except ValueError as error:
        raise ProjectError(f"{what}: {error}") from error


def _is_same(a: AttributeValue, b: AttributeValue | None) -> bool:
    """Whether values are equal, and of the same type: true is not 1."""
    return type(a) is type(b) and a == b


def _present(connection: Connection, uid: str) -> AnyRow:
    row = connection.execute(LABEL_OF_UID, {"uid": uid}).first()
    if row is None:
        raise NotFoundError(f"the project has no label {uid}; it may have been deleted; reload the frame")
    return row


def _of_tracks(
    connection: Connection, attributes: Sequence[Attribute], frame_id: int | None, tracks: Collection[int | None]
) -> dict[int | None, Values]:
    """Values of tracks in a frame's recording, by track id: of each attribute that of its first label with a value."""
    names = {each.name for each in attributes if each.of is AttributeOf.TRACK}
    known = {track for track in tracks if track is not None}
    found: dict[int | None, Values] = defaultdict(dict)
    if not names or not known:
        return found
    for row in connection.execute(labels_of_tracks(frame_id, known)):
        values = values_of(row.attributes)
        # what a source has lent goes with it
        own = names - borrowed(values, said_of(row.said))
        for name, value in values.items():
            if name in own:
                found[row.track_id].setdefault(name, value)
    return found


def labels_of_tracks(frame_id: int | None, tracks: Collection[int]) -> Select[Any]:
    """Query for the labels of tracks in a frame's recording that are not rejected, with their frames' revisions."""
    recording = select(frames.c.recording_id).where(frames.c.id == frame_id).scalar_subquery()
    query = select(labels, frames.c.revision).join(frames, frames.c.id == labels.c.frame_id)
    return query.where(
        labels.c.track_id.in_(tracks),
        frames.c.recording_id == recording,
        labels.c.state != ReviewState.REJECTED.value,
    ).order_by(labels.c.id)
