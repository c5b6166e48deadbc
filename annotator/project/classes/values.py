"""Values of attributes: which a label gets from the schema, its track and other sources, and which a file gives it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import Connection, Select, select

from annotator.project.classes.attributes import MEASURED, Attribute, AttributeOf, fitting
from annotator.project.database.schema import frames, labels
from annotator.project.recordings import of_rig
from annotator.project.records import SaidRecord
from annotator.project.rows import Terms, values_of
from annotator.types import ReviewState, Source
from annotator.types.errors import ProjectError
from annotator.types.label import AttributeValue
from annotator.types.messages import alternatives

Values = dict[str, AttributeValue]


def after_edit(
    attributes: Sequence[Attribute],
    present: Mapping[str, AttributeValue],
    before: str,
    after: str,
    of_track: Mapping[str, AttributeValue],
) -> Values:
    """The values of a label after its class or its track has changed.

    Args:
        of_track: the values of its new track; empty for the same one.
    """
    values = dict(present)
    if after != before:
        lacks = {each.name for each in attributes if not each.is_of(after)}
        values = {name: value for name, value in values.items() if name not in lacks}
        for each in attributes:
            if each.is_of(after) and each.default is not None:
                values.setdefault(each.name, each.default)
    return values | {
        each.name: of_track[each.name] for each in attributes if each.is_of(after) and each.name in of_track
    }


def new_values(of_label: Iterable[Attribute], of_track: Mapping[str, AttributeValue], given: Values) -> Values:
    """Values of a new label: those given, else those of its track, else the defaults."""
    values: Values = {}
    for each in of_label:
        value = given.get(each.name, of_track.get(each.name, each.default))
        if value is not None:
            values[each.name] = each.checked(value)
    return values


def checked(attributes: Iterable[Attribute], values: Mapping[str, AttributeValue], what: str) -> Values:
    """The values as they are stored; refuses those that no attribute takes. `what` has them, for the message."""
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


def is_same(a: AttributeValue, b: AttributeValue | None) -> bool:
    """Whether values are equal, and of the same type: true is not 1."""
    return type(a) is type(b) and a == b


def of_tracks(
    connection: Connection,
    terms: Terms,
    attributes: Sequence[Attribute],
    frame_id: int | None,
    tracks: Collection[int | None],
) -> dict[int | None, Values]:
    """Values of tracks in a frame's rig, by track id: of each attribute that of its first label with a value."""
    names = {each.name for each in attributes if each.of is AttributeOf.TRACK}
    known = {track for track in tracks if track is not None}
    found: dict[int | None, Values] = defaultdict(dict)
    if not names or not known:
        return found
    for row in connection.execute(labels_of_tracks(frame_id, known)):
        values = values_of(row.attributes)
        # what a source has lent goes with it
        own = names - borrowed(values, terms.said(row.said, row.frame_id))
        for name, value in values.items():
            if name in own:
                found[row.track_id].setdefault(name, value)
    return found


def labels_of_tracks(frame_id: int | None, tracks: Collection[int]) -> Select[Any]:
    """Query for the labels of tracks in a frame's rig that are not rejected, with their frames' revisions."""
    here = frames.alias()
    recording = select(here.c.recording_id).where(here.c.id == frame_id).scalar_subquery()
    query = select(labels, frames.c.revision).join(frames, frames.c.id == labels.c.frame_id)
    return query.where(
        labels.c.track_id.in_(tracks),
        of_rig(recording),
        labels.c.state != ReviewState.REJECTED.value,
    ).order_by(labels.c.id)


def is_kept(row: Mapping[str, Any], label: str, said: Sequence[SaidRecord], attributes: Sequence[Attribute]) -> bool:
    """Whether no pass and no import replaces a proposal, because a person has set values that a new one would not have.

    Values that follow from those of another label of the track do not count: whoever sets the colour of a car does not
    keep its boxes in all frames.
    """
    if not row["values_set"] or row["state"] != ReviewState.PROPOSED.value:
        return False
    usual = {each.name: each.default for each in attributes if each.is_of(label) and each.default is not None}
    if row["source"] == Source.IMPORTED.value:
        usual |= said[0].attributes
    else:
        usual |= {name: each.attributes[name] for each in said for name in each.lent}
    return values_of(row["attributes"]) != usual


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


# --- values that a proposal gets from the hidden boxes of its object --------------------------------------------------
# The shown box of an object keeps its own values. It lacks those that only another source gave, so these are lent to
# it, until that source says otherwise. A value that is the default says nothing, whoever has it.


def lend(
    of_label: Sequence[Attribute], own: Mapping[str, AttributeValue], others: Sequence[SaidRecord]
) -> tuple[Values, tuple[SaidRecord, ...]]:
    """The values of an object, and the hidden boxes, each with what it lends; what surer boxes say comes first.

    Args:
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
    return values, tuple(lenders)


def conflicts(of_label: Sequence[Attribute], said: Sequence[SaidRecord], source: str) -> int:
    """Number of values that `source` says of an object, and another source says otherwise."""
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
