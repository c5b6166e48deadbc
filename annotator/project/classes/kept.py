"""Proposals that no automatic pass and no import replaces: a person has set values of their attributes."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection, bindparam, select

from annotator.project.classes.applying import values_of
from annotator.project.classes.attributes import Attribute
from annotator.project.database.schema import events, labels
from annotator.project.log.event_types import PAYLOAD, LabelAttributesSet
from annotator.project.log.records import parsed, said_of
from annotator.types import ReviewState, Source

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
