"""`annotator classes`: the classes and attributes of a project."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import ValidationError
from tyro.conf import arg

from annotator.cli.options import AsJson, names_in
from annotator.cli.output import facts, print_line, print_lines, print_result
from annotator.project import Project, ProjectConfig
from annotator.project.classes import edit
from annotator.project.classes.attributes import (
    Attribute,
    AttributeKind,
    AttributeOf,
)
from annotator.project.classes.counts import ClassCounts
from annotator.project.classes.edit import ClassEdit
from annotator.project.overview import ClassRow, list_classes
from annotator.types.errors import ConfigError
from annotator.types.messages import amount, first_problem

AUTHOR = "annotator classes"

ClassName = Annotated[str, arg(help="name of the class.")]
Colour = Annotated[str | None, arg(metavar="RRGGBB", help="colour on the page, six hexadecimal digits.")]
Unsettable = Literal["minimum", "maximum", "classes", "default", "key"]
UnsettableStyle = Literal["colour", "key", "still"]
_UNSET = {"classes": ()}
Key = Annotated[str | None, arg(help="key on the page, one of 0 to 9 and a to z.")]


def show(project: Project, /, *, as_json: AsJson = False) -> None:
    """List a project's classes, with the number of their boxes, and its attributes."""
    listed = list_classes(project)
    lines = [*facts((row.name, _described(row)) for row in listed.classes), *map(_attribute_line, listed.attributes)]
    print_result(listed, lines, as_json)


def add(project: Project, name: ClassName, /, *, colour: Colour = None, key: Key = None) -> None:
    """Add a class at the end. Detectors find it after the next training."""
    _change(project, lambda config: edit.AddClass(name=name, style=_looks(colour, key))(config))


def style(
    project: Project,
    name: ClassName,
    /,
    *,
    colour: Colour = None,
    key: Key = None,
    still: bool = False,
    unset: tuple[UnsettableStyle, ...] = (),
) -> None:
    """Set the colour and the key of a class on the page, and whether its objects stand still.

    Args:
        still: its objects stand still, such as furniture and signs: `annotator tracks still` names their tracks.
        unset: settings to remove.
    """
    given = _looks(colour, key) | ({"still": True} if still else {})
    _require_one_of_both(given, unset)
    _change(project, lambda config: edit.StyleClass(name=name, style={**given, **dict.fromkeys(unset)})(config))


def order(project: Project, names: tuple[str, ...], /) -> None:
    """Set the order of the classes.

    Args:
        names: all classes of the project, with spaces or commas between them.
    """
    ordered = names_in(names, project.config.classes)
    _change(project, lambda config: edit.Reorder(names=ordered)(config))


def order_attributes(project: Project, names: tuple[str, ...], /) -> None:
    """Set the order of the attributes.

    Args:
        names: all attributes of the project, with spaces or commas between them.
    """
    known = [each.name for each in project.config.attributes]
    ordered = names_in(names, known)
    _change(project, lambda config: edit.Reorder(do="order_attributes", names=ordered)(config), attributes=known)


def rename(project: Project, old: str, new: str, /) -> None:
    """Rename a class. Its 2D and 3D boxes follow, and so do the results of detectors that know the old name.

    Args:
        old: present name.
        new: new name.
    """
    _change(project, lambda config: edit.RenameClass(name=old, new=new)(config), old)


def merge(project: Project, old: tuple[str, ...], /, *, into: str) -> None:
    """Give all boxes of some classes to another class, and remove these classes.

    Args:
        old: names of the classes, with spaces or commas between them.
        into: class that gets the boxes.
    """
    names = names_in(old, project.config.classes)
    _change(project, lambda config: edit.MergeClasses(names=names, into=into)(config), *names)


def remove(
    project: Project,
    name: ClassName,
    /,
    *,
    into: str | None = None,
    with_boxes: bool = False,
) -> None:
    """Remove a class. One that has boxes needs --into or --with-boxes.

    Args:
        into: class that gets the boxes.
        with_boxes: also remove all boxes of the class.
    """
    if into is not None:
        if with_boxes:
            raise ConfigError("--into keeps the boxes and --with-boxes removes them; give one of both")
        merge(project, (name,), into=into)
        return
    _change(
        project,
        lambda config: edit.RemoveClass(name=name, with_boxes=with_boxes)(config),
        *([name] if with_boxes else []),
        verb="removed with the class",
    )


def attribute(
    project: Project,
    name: str,
    /,
    *,
    kind: AttributeKind | None = None,
    of: AttributeOf | None = None,
    choices: tuple[str, ...] = (),
    minimum: float | None = None,
    maximum: float | None = None,
    classes: tuple[str, ...] = (),
    required: bool = False,
    optional: bool = False,
    default: Annotated[str | None, arg(aliases=("--value",))] = None,
    key: Key = None,
    unset: tuple[Unsettable, ...] = (),
    drop: bool = False,
) -> None:
    """Add an attribute, or change the given settings of an existing one. Boxes without a value get the default value.

    Args:
        name: name of the attribute.
        kind: kind of its values; a new attribute needs it.
        of: what has the attribute: each box, a track (the same value in all its boxes), or a frame.
        choices: the values of the kind choice, with spaces or commas between them.
        minimum: smallest number.
        maximum: greatest number.
        classes: classes that have the attribute, with spaces or commas between them; default: all.
        required: let checks report boxes without a value.
        optional: let checks accept boxes without a value.
        default: value of new boxes.
        unset: settings to remove.
        drop: remove stored values that do not fit.
    """
    given_here = {"minimum": minimum, "maximum": maximum, "classes": classes or None, "default": default, "key": key}
    _require_one_of_both(given_here, unset)

    def put(config: ProjectConfig) -> ClassEdit:
        known = {each.name: each for each in config.attributes}
        if name not in known and kind is None:
            raise ConfigError(f"a new attribute needs --kind, one of {', '.join(AttributeKind)}")
        given: dict[str, Any] = {"kind": kind, "of": of, "minimum": minimum, "maximum": maximum, "key": key}
        given |= {
            "choices": names_in(choices) or None,
            "classes": names_in(classes, config.classes) or None,
            "required": required or (False if optional else None),
        }
        fields = known[name].model_dump() if name in known else {"name": name}
        fields |= {field: each for field, each in given.items() if each is not None}
        fields |= {field: _UNSET.get(field) for field in unset}
        for label in given["classes"] or ():
            edit.require_class(config, label)
        try:
            # the old default need not fit the new limits
            made = Attribute.model_validate(fields if default is None else fields | {"default": None})
            if default is not None:
                made = made.model_copy(update={"default": made.read(default)})
        except ValidationError as error:
            raise ConfigError(first_problem(error)) from error
        except ValueError as error:
            raise ConfigError(f"--default: {error}") from error
        return edit.PutAttribute(attribute=made, drop=drop)(config)

    _change(project, put, attributes=[name])


def remove_attribute(project: Project, name: str, /) -> None:
    """Remove an attribute with all its values.

    Args:
        name: name of the attribute.
    """
    number = sum(project.value_counts().get(name, {}).values())
    _change(project, lambda config: edit.RemoveAttribute(name=name)(config), attributes=())
    print_line(f"removed {name} and {amount(number, 'value')} of it")


def rename_attribute(project: Project, old: str, new: str, /) -> None:
    """Rename an attribute, or a choice given as ATTRIBUTE=CHOICE; values follow.

    Args:
        old: present name, or ATTRIBUTE=CHOICE.
        new: new name; that of another choice merges both.
    """
    name, is_choice, choice = old.partition("=")
    old_choice = choice if is_choice else None
    _change(
        project,
        lambda config: edit.RenameAttribute(name=name, choice=old_choice, new=new)(config),
        attributes=[name if is_choice else new],
    )


def _change(
    project: Project,
    change: Callable[[ProjectConfig], ClassEdit],
    *followed: str,
    verb: str = "relabelled",
    attributes: Collection[str] | None = None,
) -> None:
    """Changes a project; prints how many boxes of the classes `followed` were concerned, and the classes, or these
    attributes. The change is made within the call, which tells what is wrong with its names."""
    before = project.class_counts()
    config = project.change_classes(change, AUTHOR)
    print_lines(_followed(before, followed, verb))
    if attributes is None:
        print_line(f"{config.name}: {', '.join(config.classes)}")
    print_lines(_attribute_line(each) for each in config.attributes if each.name in (attributes or ()))


def _followed(before: dict[str, ClassCounts], names: tuple[str, ...], verb: str) -> Iterator[str]:
    for name in names:
        count = before.get(name, ClassCounts())
        said = f", and {amount(count.said, 'further 3D box')} of sources" if count.said else ""
        yield f"{verb}: {amount(count.labels, 'label')} and {amount(count.boxes_2d, '2D box')} of {name}{said}"


def _require_one_of_both(given: Mapping[Any, object], unset: Collection[str]) -> None:
    both = sorted(set(unset) & {field for field, each in given.items() if each is not None})
    if both:
        raise ConfigError(f"--{both[0]} sets what --unset removes; give one of both")


def _looks(colour: str | None, key: str | None) -> dict[UnsettableStyle, str | None]:
    given: dict[UnsettableStyle, str | None] = {} if colour is None else {"colour": f"#{colour.lstrip('#')}"}
    return given if key is None else {**given, "key": key}


def _described(row: ClassRow) -> str:
    more = [f"colour {row.colour}" if row.colour else "", f"key {row.key}" if row.key else ""]
    more += ["stands still"] if row.still else []
    return ", ".join(filter(None, [row.boxes, *more]))


def _attribute_line(attribute: Attribute) -> str:
    return f"attribute {attribute.name}: {attribute.words()}"
