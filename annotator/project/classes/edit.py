"""Changes of the classes and attributes, as pure functions on the configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from pydantic import ValidationError

from annotator.project.classes.attributes import MEASURED, Attribute, AttributeKind, AttributeOf, ClassStyle
from annotator.project.config import ProjectConfig
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


def add_class(config: ProjectConfig, name: str, style: ClassStyle | None = None) -> ClassEdit:
    """Adds a class at the end."""
    if name in config.classes:
        raise ConfigError(f"project {config.name} has the class {name!r} already")
    new = _with(config, classes=(*config.classes, name), class_styles=_styled(config, name, style))
    return ClassEdit(f"add the class {name}", new)


def style_class(config: ProjectConfig, name: str, style: ClassStyle) -> ClassEdit:
    """Sets the colour and the key of a class."""
    require_class(config, name)
    return ClassEdit(f"set the look of the class {name}", _with(config, class_styles=_styled(config, name, style)))


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


def order_classes(config: ProjectConfig, names: Sequence[str]) -> ClassEdit:
    """Orders the classes."""
    if sorted(names) != sorted(config.classes):
        raise ConfigError(f"the order must name each class once: {', '.join(config.classes)}")
    return ClassEdit("order the classes", _with(config, classes=tuple(names)))


def order_attributes(config: ProjectConfig, names: Sequence[str]) -> ClassEdit:
    """Orders the attributes."""
    known = {each.name: each for each in config.attributes}
    if sorted(names) != sorted(known):
        raise ConfigError(f"the order must name each attribute once: {', '.join(known)}")
    return ClassEdit("order the attributes", _with(config, attributes=tuple(known[name] for name in names)))


def rename_class(config: ProjectConfig, old: str, new: str) -> ClassEdit:
    """Renames a class; its boxes follow."""
    require_class(config, old)
    if new in config.classes:
        raise ConfigError(
            f"project {config.name} has the class {new!r} already; to give it the boxes of {old!r}, merge them: "
            f"annotator classes merge {config.name} {old} --into {new}"
        )
    classes = [new if name == old else name for name in config.classes]
    return _replaced(f"rename the class {old} to {new}", config, {old: new}, classes)


def merge_classes(config: ProjectConfig, old: Sequence[str], into: str) -> ClassEdit:
    """Gives all boxes of some classes to another one, and removes these classes."""
    if not old:
        raise ConfigError(f"name the classes whose boxes {into!r} gets")
    for name in (*old, into):
        require_class(config, name)
    if into in old:
        raise ConfigError(f"{into!r} cannot be merged into itself; name the other classes only")
    left = [name for name in config.classes if name not in old]
    return _replaced(f"merge {', '.join(old)} into the class {into}", config, dict.fromkeys(old, into), left)


def remove_class(config: ProjectConfig, name: str, *, with_boxes: bool = True) -> ClassEdit:
    """Removes a class, and its boxes."""
    require_class(config, name)
    new = with_classes(config, [label for label in config.classes if label != name])
    return ClassEdit(f"remove the class {name}", new, removed=name if with_boxes else None)


def put_attribute(config: ProjectConfig, attribute: Attribute, *, drop: bool = False) -> ClassEdit:
    """Adds an attribute, or changes the one of this name.

    Boxes without a value get its default, unless only its key changes, or whether it is required.

    Args:
        drop: remove stored values that do not fit.
    """
    known = {each.name: each for each in config.attributes}
    before = known.get(attribute.name)
    has_new_default = attribute.default is not None and (before is None or before.default != attribute.default)
    if has_new_default and attribute.name in MEASURED and attribute.of is not AttributeOf.FRAME:
        raise ConfigError(
            f"attribute {attribute.name} cannot have a default: exports measure it for boxes without a value, and a "
            "default would replace what they measure; leave the default out"
        )
    if before is not None and before.of is not attribute.of and AttributeOf.FRAME in (before.of, attribute.of):
        raise ConfigError(
            f"attribute {attribute.name} belongs to a {before.of}; its values cannot move to a {attribute.of}; remove "
            "it first, or choose another name"
        )
    is_other_look = before not in (None, attribute) and attribute.has_same_values(before)
    fills = attribute.default is not None and attribute.of is not AttributeOf.FRAME and not is_other_look

    def values(label: str | None, present: Mapping[str, AttributeValue]) -> dict[str, AttributeValue]:
        new, name = dict(present), attribute.name
        has = label is None or attribute.is_of(label)
        if drop and name in new and not (has and attribute.fits(new[name])):
            del new[name]
        if fills and attribute.default is not None and label is not None and has:
            new.setdefault(name, attribute.checked(attribute.default))
        return new

    words = f"{'add' if before is None else 'change'} the attribute {attribute.name}"
    new = _with(config, attributes=tuple((known | {attribute.name: attribute}).values()))
    return ClassEdit(words, new, values=values if fills or drop else None)


def rename_attribute(config: ProjectConfig, old: str, new: str) -> ClassEdit:
    """Renames an attribute; its values follow."""
    find_attribute(config, old)
    if any(each.name == new for each in config.attributes):
        raise ConfigError(f"project {config.name} has the attribute {new!r} already")
    renamed = [each.model_dump() | {"name": new} if each.name == old else each for each in config.attributes]
    words = f"rename the attribute {old} to {new}"
    return ClassEdit(
        words,
        _with(config, attributes=renamed),
        values=lambda _, values: {new if name == old else name: value for name, value in values.items()},
    )


def remove_attribute(config: ProjectConfig, name: str) -> ClassEdit:
    """Removes an attribute with its values."""
    find_attribute(config, name)
    left = tuple(each for each in config.attributes if each.name != name)
    return ClassEdit(
        f"remove the attribute {name}",
        _with(config, attributes=left),
        values=lambda _, values: {each: value for each, value in values.items() if each != name},
    )


def rename_choice(config: ProjectConfig, name: str, old: str, new: str) -> ClassEdit:
    """Renames a choice, or merges it into another one; values follow."""
    attribute = find_attribute(config, name)
    if attribute.kind is not AttributeKind.CHOICE or old not in attribute.choices:
        raise NotFoundError(f"attribute {name} has no choice {old!r}; it takes {attribute.values_text()}")
    choices = list(dict.fromkeys(new if choice == old else choice for choice in attribute.choices))
    default = new if attribute.default == old else attribute.default
    changed = attribute.model_dump() | {"choices": choices, "default": default}
    attributes = [changed if each.name == name else each for each in config.attributes]
    words = f"rename {old} of the attribute {name} to {new}"
    return ClassEdit(
        words,
        _with(config, attributes=attributes),
        values=lambda _, values: {**values, name: new} if values.get(name) == old else dict(values),
    )


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


def _styled(config: ProjectConfig, name: str, style: ClassStyle | None) -> dict[str, ClassStyle]:
    styles = config.class_styles | {name: style or ClassStyle()}
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
