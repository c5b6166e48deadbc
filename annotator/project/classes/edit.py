"""Changes of the classes and attributes: each is called with the configuration, and says what becomes of it.

The page sends them as they are; the commands make them. Values in them are checked when they are called.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from annotator.project.classes.attributes import MEASURED, Attribute, AttributeKind, AttributeOf, ClassStyle
from annotator.project.config import ProjectConfig
from annotator.types.bases import Strict
from annotator.types.errors import ConfigError, NotFoundError
from annotator.types.label import AttributeValue
from annotator.types.messages import alternatives, first_problem


@dataclass(frozen=True)
class ClassEdit:
    """A change in words: the new configuration, and what happens to stored boxes.

    Attributes:
        names: old name of a class -> new one; several old ones may get the same.
        removed: the class whose boxes go.
        values: the values of a box of a class (its new name; None: of a frame) -> those after the change; None: they
            stay.
    """

    words: str
    config: ProjectConfig
    names: Mapping[str, str] = field(default_factory=dict)
    removed: str | None = None
    values: Callable[[str | None, Mapping[str, AttributeValue]], dict[str, AttributeValue]] | None = None


# Bounds of what is sent: longer names are refused before they are compared with others.
Name = Annotated[str, Field(max_length=64)]
Names = Annotated[tuple[Name, ...], Field(max_length=1000)]
Looks = dict[Literal["colour", "key", "still"], Annotated[str, Field(max_length=1000)] | bool | None]


class AddClass(Strict):
    """Adds a class at the end, with a colour and a key."""

    do: Literal["add"] = "add"
    name: Name
    style: Looks = Field(default_factory=dict)

    def __call__(self, config: ProjectConfig) -> ClassEdit:
        if self.name in config.classes:
            raise ConfigError(f"project {config.name} has the class {self.name!r} already")
        styles = _styled(config, self.name, ClassStyle.model_validate(self.style))
        new = _with(config, classes=(*config.classes, self.name), class_styles=styles)
        return ClassEdit(f"add the class {self.name}", new)


class StyleClass(Strict):
    """Sets colour and key of a class; null = none, what is not given stays."""

    do: Literal["style"] = "style"
    name: Name
    style: Looks

    def __call__(self, config: ProjectConfig) -> ClassEdit:
        require_class(config, self.name)
        before = config.class_styles.get(self.name, ClassStyle()).model_dump()
        styles = _styled(config, self.name, ClassStyle.model_validate(before | self.style))
        return ClassEdit(f"set the look of the class {self.name}", _with(config, class_styles=styles))


class Reorder(Strict):
    """Orders the classes or the attributes."""

    do: Literal["order", "order_attributes"] = "order"
    names: Names

    def __call__(self, config: ProjectConfig) -> ClassEdit:
        what, field = ("class", "classes") if self.do == "order" else ("attribute", "attributes")
        known = {getattr(each, "name", each): each for each in getattr(config, field)}
        if sorted(self.names) != sorted(known):
            raise ConfigError(f"the order must name each {what} once: {', '.join(known)}")
        ordered = _with(config, **{field: tuple(known[name] for name in self.names)})
        return ClassEdit(f"order the {field}", ordered)


class RenameClass(Strict):
    """Renames a class; its boxes follow."""

    do: Literal["rename"] = "rename"
    name: Name
    new: Name

    def __call__(self, config: ProjectConfig) -> ClassEdit:
        require_class(config, self.name)
        if self.new in config.classes:
            raise ConfigError(
                f"project {config.name} has the class {self.new!r} already; to give it the boxes of {self.name!r}, "
                f"merge them (annotator classes merge {config.name} {self.name} --into {self.new})"
            )
        classes = [self.new if name == self.name else name for name in config.classes]
        return _replaced(f"rename the class {self.name} to {self.new}", config, {self.name: self.new}, classes)


class MergeClasses(Strict):
    """Gives all boxes of some classes to another one, and removes these classes."""

    do: Literal["merge"] = "merge"
    names: Names
    into: Name

    def __call__(self, config: ProjectConfig) -> ClassEdit:
        if not self.names:
            raise ConfigError(f"name the classes whose boxes {self.into!r} gets")
        for name in (*self.names, self.into):
            require_class(config, name)
        if self.into in self.names:
            raise ConfigError(f"{self.into!r} cannot be merged into itself; name the other classes only")
        left = [name for name in config.classes if name not in self.names]
        words = f"merge {', '.join(self.names)} into the class {self.into}"
        return _replaced(words, config, dict.fromkeys(self.names, self.into), left)


class RemoveClass(Strict):
    """Removes a class; one that has boxes only with them."""

    do: Literal["remove"] = "remove"
    name: Name
    with_boxes: bool = False

    def __call__(self, config: ProjectConfig) -> ClassEdit:
        require_class(config, self.name)
        new = with_classes(config, [label for label in config.classes if label != self.name])
        return ClassEdit(f"remove the class {self.name}", new, removed=self.name if self.with_boxes else None)


class PutAttribute(Strict):
    """Adds an attribute, or changes the one of this name; with `drop`, stored values that do not fit are removed.

    Boxes without a value get its default, unless only its key changes, or whether it is required.
    """

    do: Literal["attribute"] = "attribute"
    # one that contradicts itself is refused when it is called, with a message for the operator
    attribute: Attribute | dict[Name, Any]
    drop: bool = False

    def __call__(self, config: ProjectConfig) -> ClassEdit:
        attribute = Attribute.model_validate(self.attribute)
        known = {each.name: each for each in config.attributes}
        before = known.get(attribute.name)
        has_new_default = attribute.default is not None and (before is None or before.default != attribute.default)
        if has_new_default and attribute.name in MEASURED and attribute.of is not AttributeOf.FRAME:
            raise ConfigError(
                f"attribute {attribute.name} cannot have a default: exports measure it for boxes without a value, and "
                "a default would replace what they measure; leave the default out"
            )
        if before is not None and before.of is not attribute.of and AttributeOf.FRAME in (before.of, attribute.of):
            raise ConfigError(
                f"attribute {attribute.name} belongs to a {before.of}; its values cannot move to a {attribute.of}; "
                "remove it first, or choose another name"
            )
        is_other_look = before not in (None, attribute) and attribute.has_same_values(before)
        fills = attribute.default is not None and attribute.of is not AttributeOf.FRAME and not is_other_look

        def values(label: str | None, present: Mapping[str, AttributeValue]) -> dict[str, AttributeValue]:
            new, name = dict(present), attribute.name
            has = label is None or attribute.is_of(label)
            if self.drop and name in new and not (has and attribute.fits(new[name])):
                del new[name]
            if fills and attribute.default is not None and label is not None and has:
                new.setdefault(name, attribute.checked(attribute.default))
            return new

        words = f"{'add' if before is None else 'change'} the attribute {attribute.name}"
        new = _with(config, attributes=tuple((known | {attribute.name: attribute}).values()))
        return ClassEdit(words, new, values=values if fills or self.drop else None)


class RenameAttribute(Strict):
    """Renames an attribute, or one of its choices, or merges that into another one; values follow."""

    do: Literal["rename_attribute"] = "rename_attribute"
    name: Name
    choice: Name | None = None
    new: Name

    def __call__(self, config: ProjectConfig) -> ClassEdit:
        attribute, name, new, old = find_attribute(config, self.name), self.name, self.new, self.choice
        if old is None:
            if any(each.name == new for each in config.attributes):
                raise ConfigError(f"project {config.name} has the attribute {new!r} already")
            words = f"rename the attribute {name} to {new}"
            changes: dict[str, Any] = {"name": new}
        elif attribute.kind is not AttributeKind.CHOICE or old not in attribute.choices:
            raise NotFoundError(f"attribute {name} has no choice {old!r}; it takes {attribute.values_text()}")
        else:
            words = f"rename {old} of the attribute {name} to {new}"
            choices = dict.fromkeys(new if choice == old else choice for choice in attribute.choices)
            changes = {"choices": list(choices), "default": new if attribute.default == old else attribute.default}

        def values(_: str | None, values: Mapping[str, AttributeValue]) -> dict[str, AttributeValue]:
            if old is None:
                return {new if each == name else each: value for each, value in values.items()}
            return {**values, name: new} if values.get(name) == old else dict(values)

        changed = [each.model_dump() | changes if each.name == name else each for each in config.attributes]
        return ClassEdit(words, _with(config, attributes=changed), values=values)


class RemoveAttribute(Strict):
    """Removes an attribute with its values."""

    do: Literal["remove_attribute"] = "remove_attribute"
    name: Name

    def __call__(self, config: ProjectConfig) -> ClassEdit:
        find_attribute(config, self.name)
        left = tuple(each for each in config.attributes if each.name != self.name)
        return ClassEdit(
            f"remove the attribute {self.name}",
            _with(config, attributes=left),
            values=lambda _, values: {each: value for each, value in values.items() if each != self.name},
        )


ClassChange = Annotated[
    AddClass
    | StyleClass
    | Reorder
    | RenameClass
    | MergeClasses
    | RemoveClass
    | PutAttribute
    | RenameAttribute
    | RemoveAttribute,
    Field(discriminator="do"),
]


def with_classes(config: ProjectConfig, names: Sequence[str]) -> ProjectConfig:
    """The configuration with these classes; what it says of others is left out."""
    styles = {name: style for name, style in config.class_styles.items() if name in names}
    attributes = []
    for each in config.attributes:
        left = tuple(label for label in each.classes if label in names)
        if each.classes and not left:
            raise ConfigError(
                f"only {', '.join(each.classes)} has the attribute {each.name}; give it to other classes first, or "
                "remove it (`annotator classes attribute`, `remove-attribute`)"
            )
        attributes.append(each.model_copy(update={"classes": left}))
    return _with(config, classes=tuple(names), class_styles=styles, attributes=tuple(attributes))


def find_attribute(config: ProjectConfig, name: str) -> Attribute:
    """The attribute of this name."""
    found = next((each for each in config.attributes if each.name == name), None)
    if found is None:
        other = alternatives(name, [each.name for each in config.attributes])
        raise NotFoundError(f"project {config.name} has no attribute {name!r}; {other}")
    return found


def _replaced(words: str, config: ProjectConfig, names: dict[str, str], classes: Sequence[str]) -> ClassEdit:
    styles: dict[str, ClassStyle] = {}
    for name, style in config.class_styles.items():
        if name not in names:
            styles[name] = style
        elif names[name] not in config.classes:  # a renamed class keeps its style, a merged one takes the other's
            styles[names[name]] = style
    attributes = [
        each.model_copy(update={"classes": tuple(dict.fromkeys(names.get(name, name) for name in each.classes))})
        for each in config.attributes
    ]
    new = _with(config, classes=tuple(classes), class_styles=styles, attributes=tuple(attributes))
    return ClassEdit(words, new, names)


def _styled(config: ProjectConfig, name: str, style: ClassStyle) -> dict[str, ClassStyle]:
    styles = config.class_styles | {name: style}
    return {label: each for label, each in styles.items() if each != ClassStyle()}


def _with(config: ProjectConfig, **changes: object) -> ProjectConfig:
    try:
        return ProjectConfig.model_validate(dict(config) | changes)
    except ValidationError as error:
        raise ConfigError(f"project {config.name}: {first_problem(error)}") from error


def require_class(config: ProjectConfig, name: str) -> None:
    """Checks that the project has a class."""
    if name not in config.classes:
        raise NotFoundError(f"project {config.name} has no class {name!r}; {alternatives(name, config.classes)}")
