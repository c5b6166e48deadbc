"""Chooses proposals by the values of an attribute: of the box itself, its track, or its frame."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import ColumnElement, Float, Text, case, cast, func, literal, select, true

from annotator.project.classes.attributes import Value, value_text
from annotator.project.schema import frame_attributes, frames, labels


@dataclass(frozen=True)
class ValueFilter:
    """What the value of an attribute must be. Without any condition: there is no value.

    Attributes:
        name: the attribute.
        of_frame: it is one of frames, not of boxes and tracks.
        usual: of frames that have no value of their own.
        known: any value will do.
        text: the value as text.
        contains: part of the value as text; small and capital letters (a to z) count as equal.
        low, high: least and greatest value of a number.
    """

    name: str
    of_frame: bool = False
    usual: Value | None = None
    known: bool = False
    text: str | None = None
    contains: str | None = None
    low: float | None = None
    high: float | None = None

    def clause(self) -> ColumnElement[bool]:
        """The condition of a query of labels joined with their frames."""
        found = self._value()
        conditions: list[ColumnElement[bool]] = []
        if self.text is not None:
            conditions.append(found == self.text)
        if self.contains is not None:
            conditions.append(func.instr(func.lower(found), func.lower(self.contains)) > 0)
        if self.low is not None:
            conditions.append(cast(found, Float) >= self.low)
        if self.high is not None:
            conditions.append(cast(found, Float) <= self.high)
        if not conditions:
            return found.is_not(None) if self.known else found.is_(None)
        clause = conditions[0]
        for condition in conditions[1:]:
            clause &= condition
        return clause

    def _value(self) -> ColumnElement[str]:
        """The value as text; NULL without one."""
        column = frame_attributes.c.attributes if self.of_frame else labels.c.attributes
        values = func.json_each(column).table_valued("key", "value", "type")
        known = case((values.c.type.in_(("true", "false")), values.c.type), else_=cast(values.c.value, Text))
        if not self.of_frame:
            return select(known).select_from(values).where(values.c.key == self.name).scalar_subquery()
        own = select(known).select_from(frame_attributes).join(values, true())
        found = own.where(frame_attributes.c.frame_id == frames.c.id, values.c.key == self.name).scalar_subquery()
        return found if self.usual is None else func.coalesce(found, literal(value_text(self.usual)))
