"""Adds the attributes of a dataset that a project lacks, with the kind that all their values have."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pydantic import ValidationError

from annotator.formats.attributes import typed_value
from annotator.project import Project
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, AttributeOf
from annotator.types.label import AttributeValue
from annotator.workflows.importing.boxes_3d import AUTHOR
from annotator.workflows.importing.label_set import HasFrameValues, LabelSet
from annotator.workflows.importing.picture_labels import FlatFormat, read_pictures

# Texts that repeat are a choice, if there are at most so many different ones.
MOST_CHOICES = 20
LONGEST_CHOICE = 64

_Values = dict[str, list[AttributeValue]]


@dataclass(frozen=True)
class FoundValues:
    """All values in a dataset, by attribute: of boxes, and of frames."""

    of_boxes: _Values
    of_frames: _Values


def values_of_labels(dataset: LabelSet) -> FoundValues:
    """Returns the values of a dataset of 3D boxes."""
    found = FoundValues(defaultdict(list), defaultdict(list))
    for name in dataset.frames:
        for values in dataset.values_of_boxes(name):
            _add(found.of_boxes, values.items())
        if isinstance(dataset, HasFrameValues):
            _add(found.of_frames, dataset.values_of(name).items())
    return found


def values_of_pictures(format: FlatFormat, path: Path) -> FoundValues:
    """Returns the values of a dataset of 2D boxes. Raises FormatError: as `read_pictures`."""
    found = FoundValues(defaultdict(list), defaultdict(list))
    for picture in read_pictures(format, path).pictures:
        for values in picture.values:
            _add(found.of_boxes, values.items())
        _add(found.of_frames, picture.attributes.items())
    return found


def add_attributes(project: Project, found: FoundValues, author: str = AUTHOR) -> tuple[Attribute, ...]:
    """Adds the attributes that the project lacks; returns them.

    Those of boxes are not of tracks, since a file does not say what never changes. Names that an attribute cannot have
    are left out; the import reports their values.

    Raises:
        ProjectError: `project.json` cannot be written.
    """
    known = {each.name for each in project.config.attributes}
    new = [
        *_attributes(found.of_boxes, known, AttributeOf.BOX),
        *_attributes(found.of_frames, known | found.of_boxes.keys(), AttributeOf.FRAME),
    ]
    for attribute in new:
        project.change_classes(partial(edit.put_attribute, attribute=attribute), author)
    return tuple(new)


def _add(values: _Values, named: Iterable[tuple[str, AttributeValue]]) -> None:
    for name, value in named:
        values[name].append(value)


def _attributes(values: _Values, known: Iterable[str], of: AttributeOf) -> Iterator[Attribute]:
    for name in sorted(values.keys() - set(known)):
        kind = _kind(values[name])
        choices = sorted({str(each) for each in values[name]}) if kind is AttributeKind.CHOICE else ()
        try:
            yield Attribute(name=name, kind=kind, of=of, choices=tuple(choices))
        except ValidationError:  # no name of an attribute
            continue


def _kind(values: Sequence[AttributeValue]) -> AttributeKind:
    """The narrowest kind that all values have. Where all of them are texts, none is a number, whatever it looks like:
    it may be a number plate."""
    kinds = {type(each) for each in values}
    if kinds != {str}:
        kinds = {type(typed_value(each) if isinstance(each, str) else each) for each in values}
    if bool in kinds:
        return AttributeKind.BOOLEAN if kinds == {bool} else AttributeKind.TEXT
    if kinds <= {int, float}:
        return AttributeKind.INTEGER if kinds == {int} else AttributeKind.NUMBER
    different = {str(each) for each in values}
    repeats = 2 * len(different) <= len(values) and len(different) <= MOST_CHOICES
    return AttributeKind.CHOICE if repeats and all(map(_is_choice, different)) else AttributeKind.TEXT


def _is_choice(text: str) -> bool:
    return 0 < len(text) <= LONGEST_CHOICE
