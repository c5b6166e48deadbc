"""What a change of the classes or attributes does to stored labels: pure functions on their values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from pydantic import BaseModel, ConfigDict, Field

from annotator.project.classes.attributes import Attribute, Value
from annotator.types import Box2D
from annotator.types.label import AttributeValue


class Filled(BaseModel):
    """A value for the boxes of some classes (none: of all) that have no value of an attribute."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    value: Value
    classes: tuple[str, ...] = ()


class Relabelling(BaseModel):
    """What happens to stored labels.

    Attributes:
        classes: old name -> new name; several old ones may get the same.
        removed: classes whose boxes are removed.
        attributes: old name -> new name.
        dropped: attributes whose values are removed.
        choices: attribute (by its new name) -> old choice -> new choice.
        filled: values for boxes without one, the classes by their new names.
        fitted: attributes whose definition is narrower now; values that do not fit are removed.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    classes: dict[str, str] = Field(default_factory=dict)
    removed: tuple[str, ...] = ()
    attributes: dict[str, str] = Field(default_factory=dict)
    dropped: tuple[str, ...] = ()
    choices: dict[str, dict[str, str]] = Field(default_factory=dict)
    filled: tuple[Filled, ...] = ()
    fitted: tuple[Attribute, ...] = ()

    @property
    def changes_boxes(self) -> bool:
        """Whether class names of boxes change."""
        return bool(self.classes or self.removed)

    def label(self, name: str) -> str | None:
        """A class name after the change; None for a removed class."""
        return None if name in self.removed else self.classes.get(name, name)

    def values(self, values: Mapping[str, AttributeValue]) -> dict[str, AttributeValue]:
        """The values of a label or frame after the change."""
        kept = {self.attributes.get(name, name): value for name, value in values.items() if name not in self.dropped}
        new = {name: self._choice(name, value) for name, value in kept.items()}
        narrow = {attribute.name: attribute for attribute in self.fitted}
        return {name: value for name, value in new.items() if name not in narrow or narrow[name].fits(value)}

    def values_of(self, label: str, values: Mapping[str, AttributeValue]) -> dict[str, AttributeValue]:
        """As `values`, of a label of the class `label` (its new name), with values filled in."""
        lacks = {attribute.name for attribute in self.fitted if not attribute.is_of(label)}
        new = {name: value for name, value in self.values(values).items() if name not in lacks}
        for each in self.filled:
            if not each.classes or label in each.classes:
                new.setdefault(each.name, each.value)
        return new

    def boxes(self, boxes: Iterable[Box2D]) -> tuple[Box2D, ...]:
        """2D boxes after the change."""
        return tuple(new for new in map(self.box, boxes) if new is not None)

    def box(self, box: Box2D | None) -> Box2D | None:
        """A 2D box after the change; None for a removed class."""
        name = None if box is None else self.label(box.label)
        return None if box is None or name is None else replace(box, label=name)

    def _choice(self, name: str, value: AttributeValue) -> AttributeValue:
        return self.choices.get(name, {}).get(value, value) if isinstance(value, str) else value


def renamed_over(changes: Iterable[Relabelling], names: Iterable[str]) -> dict[str, str | None]:
    """Class name -> its name after several changes, in order; None for a removed one."""
    new: dict[str, str | None] = {name: name for name in names}
    for change in changes:
        new = {old: None if name is None else change.label(name) for old, name in new.items()}
    return new
