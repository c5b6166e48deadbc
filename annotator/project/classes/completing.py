"""Values of attributes that follow from the schema, a track or other sources: with them, events are complete."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Select, bindparam, select

from annotator.project.classes.applying import frame_values, values_of
from annotator.project.classes.attributes import MEASURED, Attribute, AttributeOf, fitting
from annotator.project.database.schema import LABEL_OF_UID, AnyRow, events, frames, labels
from annotator.project.log.event_types import (
    PAYLOAD,
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
from annotator.project.log.records import SaidRecord, parsed, said_of, track_of
from annotator.types import ReviewState, Source
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


# --- proposals that no automatic pass and no import replaces ----------------------------------------------------------

# Built once, since building a statement takes longer than running it.
_VALUES_SET = select(events.c.payload, events.c.subject).where(
    events.c.frame_id == bindparam("frame"),
    events.c.kind == "label_attributes_set",
    events.c.source == Source.MANUAL.value,
)


def kept_proposals(connection: Connection, attributes: Sequence[Attribute], frame_id: int) -> frozenset[str]:
    """Uids of a frame's open proposals that have values which a person has set, and a new proposal would not have.

    Values that follow from those of another label of the track do not count: whoever sets the colour of a car does not
    keep its boxes in all frames.

    Args:
        attributes: of the project.
    """
    touched = set[str]()
    for row in connection.execute(_VALUES_SET, {"frame": frame_id}):
        payload = parsed(PAYLOAD.validate_json, row.payload)
        if isinstance(payload, LabelAttributesSet) and row.subject in (None, payload.uid):
            touched.add(payload.uid)
    if not touched:
        return frozenset()
    names = ("uid", "label", "attributes", "source", "said")
    columns = select(*(labels.c[name] for name in names))
    is_open = (labels.c.frame_id == frame_id) & (labels.c.state == ReviewState.PROPOSED.value)
    kept = set[str]()
    for uid, label, values, source, said in connection.execute(columns.where(is_open, labels.c.uid.in_(touched))):
        usual = {each.name: each.default for each in attributes if each.is_of(label) and each.default is not None}
        if source == Source.IMPORTED.value:
            usual |= said_of(said)[0].attributes
        else:
            usual |= {name: each.attributes[name] for each in said_of(said) for name in each.lent}
        if values_of(values) != usual:
            kept.add(uid)
    return frozenset(kept)


# --- values that a proposal gets from the hidden boxes of its object --------------------------------------------------
# The shown box of an object keeps its own values. It lacks those that only another source gave, so these are lent to
# it, until that source says otherwise. A value that is the default says nothing, whoever has it.


@dataclass(frozen=True)
class Lent:
    """The values of one object.

    Attributes:
        values: those of the shown box, and those lent to it.
        others: the hidden boxes; each knows what it has lent.
    """

    values: Values
    others: tuple[SaidRecord, ...]


def lend(of_label: Sequence[Attribute], own: Mapping[str, AttributeValue], others: Sequence[SaidRecord]) -> Lent:
    """Returns the values of an object; what surer boxes say comes first.

    Args:
        of_label: attributes of the shown box's class.
        own: values of the shown box.
        others: the hidden boxes, the surest first.
    """
    values = fitting(of_label, own)
    said = set(_told(of_label, own))
    lenders = list[SaidRecord]()
    for each in others:
        new = {name: value for name, value in _told(of_label, each.attributes).items() if name not in said}
        values |= new
        said |= new.keys()
        lenders.append(each.model_copy(update={"lent": tuple(sorted(new))}))
    return Lent(values, tuple(lenders))


def conflicts(of_label: Sequence[Attribute], said: Sequence[SaidRecord], source: str) -> int:
    """Number of values that `source` says of an object, and another source says otherwise.

    Args:
        of_label: attributes of the shown box's class.
        said: all boxes of the object, each in its own words.
    """
    told = [(each.source, _told(of_label, each.attributes)) for each in said]
    others = [values for of, values in told if of != source]
    return sum(
        any(theirs.get(name, value) != value for theirs in others)
        for of, values in told
        if of == source
        for name, value in values.items()
    )


def _told(of_label: Sequence[Attribute], values: Mapping[str, AttributeValue]) -> Values:
    """The values that are not the defaults, and that attributes can hold."""
    defaults = {each.name: each.default for each in of_label}
    return {name: value for name, value in fitting(of_label, values).items() if value != defaults[name]}


def given_back(uid: str, said: Sequence[SaidRecord]) -> tuple[SaidRecord, ...]:
    """What sources say of an object, each in its own words.

    Args:
        uid: of the shown box; without it in `said` if it is ours.
    """
    lent = lent_names(said)
    return tuple(
        each.model_copy(
            update={"lent": (), "attributes": without(each.attributes, lent) if each.uid == uid else each.attributes}
        )
        for each in said
    )


def lent_names(said: Sequence[SaidRecord]) -> frozenset[str]:
    """Names of the values that hidden boxes have lent."""
    return frozenset(name for each in said for name in each.lent)


def borrowed(values: Mapping[str, AttributeValue], said: Sequence[SaidRecord]) -> frozenset[str]:
    """Names of the values of a shown box that hidden boxes have lent, and that nobody has changed since."""
    return frozenset(name for each in said for name in each.lent if values.get(name) == each.attributes.get(name))


def without(values: Mapping[str, AttributeValue], names: frozenset[str]) -> Values:
    """The values but those of some names."""
    return {name: value for name, value in values.items() if name not in names}
