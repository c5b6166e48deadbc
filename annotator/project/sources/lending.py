"""Values of attributes that a proposal gets from the hidden boxes of its object.

The shown box of an object keeps its own values. It lacks those that only another source gave, so these are lent to it,
until that source says otherwise. A value that is the default says nothing, whoever has it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from annotator.project.classes.attributes import Attribute, fitting
from annotator.project.records import SaidRecord
from annotator.types.label import AttributeValue

Values = dict[str, AttributeValue]


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
