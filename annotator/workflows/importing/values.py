"""Values of attributes that come with boxes: for the project's attributes, and for labels and frames that lack them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from pydantic import ValidationError

from annotator.formats.frame_names import PictureLabels, typed_value
from annotator.formats.frame_names import Values as Given
from annotator.formats.table import FlatFormat
from annotator.project import REVIEWED, FramePart, NewLabel, Project, WriteContext
from annotator.project.changes import FrameAttributesSet, LabelChanged, Payload
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, AttributeOf
from annotator.project.classes.values import ValueReader, Values
from annotator.project.sources import covered_by
from annotator.types import Label, ReviewState, Source
from annotator.types.errors import StaleRevisionError
from annotator.types.label import AttributeValue
from annotator.workflows.importing.label_set import LabelSet
from annotator.workflows.importing.pictures import OnImage, read_pictures
from annotator.workflows.importing.placing import AUTHOR, Importer, OwnClasses
from annotator.workflows.importing.report import ImportReport, Note
from annotator.workflows.views import drawn_of, outlines

# Texts that repeat are a choice, if there are at most so many different ones.
MOST_CHOICES = 20
LONGEST_CHOICE = 64


FoundValues = Iterable[tuple[Given, Iterable[Given]]]
"""The values in a dataset: of each frame or image, and of each of its boxes."""


def values_of_labels(dataset: LabelSet) -> FoundValues:
    """Returns the values of a dataset of 3D boxes."""
    return [(dataset.values_of(name), dataset.values_of_boxes(name)) for name in dataset.frames]


def values_of_pictures(format: FlatFormat, path: Path) -> FoundValues:
    """Returns the values of a dataset of 2D boxes."""
    return [(picture.attributes, picture.values) for picture in read_pictures(format, path).pictures]


def add_attributes(project: Project, found: FoundValues, author: str = AUTHOR) -> tuple[Attribute, ...]:
    """Adds the attributes that the project lacks; returns them.

    Those of boxes are not of tracks, since a file does not say what never changes. Names that an attribute cannot have
    are left out; the import reports their values.
    """
    known = {each.name for each in project.config.attributes}
    of_frames, of_boxes = defaultdict[str, list[AttributeValue]](list), defaultdict[str, list[AttributeValue]](list)
    for of_frame, every in found:
        for values, into in ((of_frame, of_frames), *((each, of_boxes) for each in every)):
            for name, value in values.items():
                into[name].append(value)
    new = [
        *_attributes(of_boxes, known, AttributeOf.BOX),
        *_attributes(of_frames, known | of_boxes.keys(), AttributeOf.FRAME),
    ]
    for attribute in new:
        project.change_classes(edit.PutAttribute(attribute=attribute), author)
    return tuple(new)


def _attributes(
    values: Mapping[str, list[AttributeValue]], known: Iterable[str], of: AttributeOf
) -> Iterator[Attribute]:
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
    is_choice = repeats and all(0 < len(text) <= LONGEST_CHOICE for text in different)
    return AttributeKind.CHOICE if is_choice else AttributeKind.TEXT


def give_values(
    project: Project,
    frame_id: int,
    of_frame: Values,
    of_labels: Callable[[Sequence[Label]], Mapping[str, Values]],
    importer: Importer,
) -> tuple[int, int]:
    """Gives a frame and its labels the values that they lack.

    Args:
        of_frame: values of the frame; like those of labels, they are such as the project's attributes can hold.
        of_labels: returns the values by the uid of the label, from the frame's labels.

    Returns:
        The number of values given, and of those that differ from the present ones, which stay.
    """
    while True:
        revision = project.frames.get(frame_id).revision
        has, labels = project.frames.attributes_of(frame_id), project.labels.of_frame(frame_id)
        missing, values = _lacking(of_frame, has), of_labels(labels)
        payloads: list[Payload] = [FrameAttributesSet(attributes=dict(missing))] if missing else []
        given, kept = len(missing), _differing(of_frame, has)
        for label in labels:
            missing = _lacking(values.get(label.uid, {}), label.attributes)
            payloads += [LabelChanged(uid=label.uid, attributes=dict(missing))] if missing else []
            given, kept = given + len(missing), kept + _differing(values.get(label.uid, {}), label.attributes)
        if not payloads:
            return 0, kept
        # retried if the frame was changed since it was read
        with suppress(StaleRevisionError):
            part = FramePart(frame_id, payloads, WriteContext(revision, importer.author, Source.IMPORTED))
            project.log.append_to_frames([part], importer.action)
            return given, kept


def of_covered(boxes: Sequence[NewLabel], labels: Sequence[Label]) -> dict[str, Values]:
    """Returns the values of a dataset's boxes by the uid of the reviewed label of its class that covers each."""
    reviewed = [label for label in labels if label.state in REVIEWED]
    found: dict[str, Values] = {}
    for box, cover in zip(boxes, covered_by(boxes, reviewed), strict=True):
        if cover is not None:
            found[cover.uid] = dict(box.attributes) | found.get(cover.uid, {})
    return found


class ImageValues:
    """The values of one import of 2D boxes.

    2D boxes have no attributes in a project. So those of the dataset go to the 3D labels whose outlines the boxes are,
    where these lack them.
    """

    def __init__(self, project: Project, report: ImportReport) -> None:
        self._project, self._report = project, report
        self._reader = ValueReader(project.config.attributes)

    def take(self, image: OnImage, own: OwnClasses, importer: Importer) -> None:
        """Stores the values of an image and of its boxes.

        Args:
            own: the project's class of each class of the dataset.
        """
        picture = image.labels
        if not picture.attributes and not picture.values:
            return
        of_frame, of_labels = self._reader.of_frame(picture.attributes), self._of_labels(image, own)
        given, kept = give_values(self._project, image.frame_id, of_frame, lambda labels: of_labels, importer)
        self._report.add(Note.SHOWN, given)
        self._report.add(Note.CONTRADICTED, kept)

    def leave_out(self, view: PictureLabels) -> None:
        """Counts the values of the boxes on a pseudo-view, which belong to no label."""
        self._report.add_all(
            Note.VALUE, (f"{name} (of boxes on pseudo-views)" for each in view.values for name in each)
        )

    def report_left_out(self) -> None:
        """Counts the values that the project's attributes cannot hold, once all images are read."""
        for what, number in self._reader.left_out.items():
            self._report.add(Note.VALUE, number, what)

    def _of_labels(self, image: OnImage, own: OwnClasses) -> dict[str, Values]:
        """Returns the values of the boxes by the uid of the label that each shows; counts those of other boxes."""
        every = self._project.labels.of_frame(image.frame_id)
        labels = {label.uid: label for label in every if label.state is not ReviewState.REJECTED}
        boxes = [replace(box, label=own.of(box.label) or box.label) for box in image.boxes]
        known = {} if image.camera is None else outlines(image.camera, tuple(labels.values()))
        shown = {place: uid for uid, place in drawn_of(known, boxes).items()}
        found: dict[str, Values] = {}
        for place, values in enumerate(image.labels.values):
            if place in shown:
                found[shown[place]] = self._reader.of_label(labels[shown[place]].label, values)
            else:
                self._report.add_all(Note.VALUE, (f"{name} (of 2D boxes without a 3D label)" for name in values))
        return found


def _lacking(values: Values, has: Mapping[str, AttributeValue]) -> Values:
    return {name: value for name, value in values.items() if name not in has}


def _differing(values: Values, has: Mapping[str, AttributeValue]) -> int:
    return sum(name in has and has[name] != value for name, value in values.items())
