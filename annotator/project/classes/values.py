"""Values of attributes: which a label gets from the schema, its track and other sources, and which a file gives it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import Connection, Select, select

from annotator.project.classes.attributes import MEASURED, Attribute, AttributeOf, fitting
from annotator.project.database.schema import frames, labels
from annotator.project.recordings import of_rig
from annotator.project.rows import Terms, still_of, stored_said, values_of
from annotator.types import ReviewState
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


def of_tracks(
    connection: Connection, terms: Terms, frame_id: int | None, tracks: Collection[int | None]
) -> dict[int | None, Values]:
    """Values of tracks in a frame's rig, by track id: of each attribute that of its first label with a value."""
    names = {each.name for each in terms.attributes if each.of is AttributeOf.TRACK}
    known = {track for track in tracks if track is not None}
    found: dict[int | None, Values] = defaultdict(dict)
    if not names or not known:
        return found
    for row in connection.execute(labels_of_tracks(frame_id, known)):
        # what a source has lent goes with it
        for name, value in own_values(dict(row._mapping)).items():
            if name in names:
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


def is_kept(row: Mapping[str, Any], terms: Terms) -> bool:
    """Whether no pass and no import replaces a proposal, because a person has set values that a new one would not have.

    Values that follow from those of another label of the track do not count: whoever sets the colour of a car does not
    keep its boxes in all frames.
    """
    if not row["values_set"] or row["state"] != ReviewState.PROPOSED.value:
        return False
    if row["said"] is not None:
        return values_of(row["attributes"]) != stored_said(row["said"]).given
    if row["of_source"] is not None:
        return False
    label = terms.names[row["class_id"]]
    defaults = {each.name: each.default for each in terms.attributes_of(label) if each.default is not None}
    return values_of(row["attributes"]) != defaults


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


# --- values that a proposal gets from the boxes behind it -------------------------------------------------------------
# The shown box of an object keeps its own values. It lacks those that only another source gave, so these are lent to
# it, until that source says otherwise. A value that is the default says nothing, whoever has it.


def is_open_still(row: Mapping[str, Any], terms: Terms) -> bool:
    """Whether a label is the proposal of an object that stands still, which a pass replaces."""
    is_open = row["state"] == ReviewState.PROPOSED.value and still_of(row["uid"]) is not None
    return is_open and not is_kept(row, terms)


def own_values(row: Mapping[str, Any]) -> Values:
    """The values of a label without those that other sources have lent it, and that nobody has changed since."""
    present = values_of(row["attributes"])
    if row["said"] is None or not present:
        return present
    said = stored_said(row["said"])
    changed = {name: value for name, value in present.items() if said.given.get(name) != value}
    return {name: value for name, value in said.attributes.items() if name in present} | changed


def lent(of_label: Sequence[Attribute], own: Mapping[str, AttributeValue], others: Sequence[Values]) -> Values:
    """The values that the other sources of an object lend its shown box; `others`: the surest first."""
    told, found = _told(of_label, own), Values()
    for each in others:
        found |= {name: value for name, value in _told(of_label, each).items() if name not in told | found}
    return found


def conflicts(of_label: Sequence[Attribute], own: Sequence[Values], others: Sequence[Values]) -> int:
    """Number of values that a source says of an object, and another source says otherwise."""
    told = [_told(of_label, values) for values in others]
    return sum(
        any(theirs.get(name, value) != value for theirs in told)
        for values in own
        for name, value in _told(of_label, values).items()
    )


def _told(of_label: Sequence[Attribute], values: Mapping[str, AttributeValue]) -> Values:
    """The values that are not the defaults, and that attributes can hold."""
    defaults = {each.name: each.default for each in of_label}
    return {name: value for name, value in fitting(of_label, values).items() if value != defaults[name]}
