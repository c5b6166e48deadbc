"""Gives attributes of 2D boxes on camera images to the 3D labels that they show, and those of images to frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

from annotator.project import FramePart, Project, WriteContext
from annotator.project.classes.completing import ValueReader, Values
from annotator.project.log.event_types import FrameAttributesSet, LabelAttributesSet, Payload
from annotator.types import ReviewState, Source
from annotator.types.errors import StaleRevisionError
from annotator.types.label import AttributeValue
from annotator.workflows.importing.boxes_3d import Importer
from annotator.workflows.importing.image_boxes import OnImage
from annotator.workflows.importing.picture_labels import PictureLabels
from annotator.workflows.views.pairs import drawn_of, outlines


@dataclass
class TakenValues:
    """What became of the attributes in a dataset of 2D boxes.

    Attributes:
        set: number of values that labels and frames got.
        kept: number of values of labels and frames that differ from those of the dataset, and stay.
        left_out: values that no label can hold, by attribute, with the reason in brackets.
    """

    set: int = 0
    kept: int = 0
    left_out: Counter[str] = field(default_factory=Counter)


class ImageValues:
    """The values of one import.

    2D boxes have no attributes in a project. So those of the dataset go to the 3D labels whose outlines the boxes are,
    where these lack them.

    Attributes:
        taken: of the images so far.
    """

    def __init__(self, project: Project) -> None:
        self._project = project
        self._reader = ValueReader(project.config.attributes)
        self.taken = TakenValues(left_out=self._reader.left_out)

    def take(self, image: OnImage, names: Mapping[str, str], importer: Importer) -> None:
        """Stores the values of an image and of its boxes.

        Args:
            names: the project's class of each class of the dataset that has another name.
        """
        picture = image.labels
        if not picture.attributes and not picture.values:
            return
        of_frame, of_labels = self._reader.of_frame(picture.attributes), self._of_labels(image, names)
        while True:
            frame = self._project.frames.get(image.frame_id)
            has = self._project.frames.attributes_of(frame.id)
            missing = _missing(of_frame, has)
            payloads: list[Payload] = [FrameAttributesSet(attributes=has | missing)] if missing else []
            number, kept = len(missing), _differing(of_frame, has)
            for label in self._project.labels.of_frame(frame.id):
                values = of_labels.get(label.uid, {})
                missing = _missing(values, label.attributes)
                payloads += [LabelAttributesSet(uid=label.uid, attributes=dict(missing))] if missing else []
                number, kept = number + len(missing), kept + _differing(values, label.attributes)
            context = WriteContext(frame.revision, importer.author, Source.IMPORTED)
            # retried if the frame was changed since it was read
            with suppress(StaleRevisionError):
                if payloads:
                    self._project.log.append_to_frames([FramePart(frame.id, payloads, context)], importer.action)
                self.taken.set += number
                self.taken.kept += kept
                return

    def leave_out(self, view: PictureLabels) -> None:
        """Counts the values of the boxes on a pseudo-view, which belong to no label."""
        self.taken.left_out.update(f"{name} (of boxes on pseudo-views)" for each in view.values for name in each)

    def _of_labels(self, image: OnImage, names: Mapping[str, str]) -> dict[str, Values]:
        """Returns the values of the boxes by the uid of the label that each shows; counts those of other boxes."""
        every = self._project.labels.of_frame(image.frame_id)
        labels = {label.uid: label for label in every if label.state is not ReviewState.REJECTED}
        boxes = [replace(box, label=names.get(box.label, box.label)) for box in image.boxes]
        known = {} if image.camera is None else outlines(image.camera, tuple(labels.values()))
        shown = {place: uid for uid, place in drawn_of(known, boxes).items()}
        found: dict[str, Values] = {}
        for place, values in enumerate(image.labels.values):
            if place in shown:
                found[shown[place]] = self._reader.of_label(labels[shown[place]].label, values)
            else:
                self.taken.left_out.update(f"{name} (of 2D boxes without a 3D label)" for name in values)
        return found


def _missing(values: Values, has: Mapping[str, AttributeValue]) -> Values:
    return {name: value for name, value in values.items() if name not in has}


def _differing(values: Values, has: Mapping[str, AttributeValue]) -> int:
    return sum(name in has and has[name] != value for name, value in values.items())
