"""Gives labels that frames have already the values that they lack, of the same objects in a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from annotator.project import REVIEWED, FramePart, NewLabel, Project, WriteContext
from annotator.project.classes.completing import Values
from annotator.project.log.event_types import LabelAttributesSet, Payload
from annotator.project.sources import covered_by
from annotator.types import Source
from annotator.types.errors import StaleRevisionError


def give_missing_values(
    project: Project, frame_id: int, boxes: Sequence[NewLabel], author: str, action: str | None
) -> int:
    """Stores values of boxes in the reviewed labels of their classes that cover them; returns how many.

    Args:
        boxes: of the dataset, with values that the project's attributes can hold.
        action: as in `Importer`.
    """
    while True:
        revision = project.frames.get(frame_id).revision
        labels = {label.uid: label for label in project.labels.of_frame(frame_id) if label.state in REVIEWED}
        missing: dict[str, Values] = {}
        for box, uid in zip(boxes, covered_by(boxes, labels.values()), strict=True):
            if uid is not None:
                has = labels[uid].attributes.keys() | missing.get(uid, {}).keys()
                if new := {name: value for name, value in box.attributes.items() if name not in has}:
                    missing.setdefault(uid, {}).update(new)
        if not missing:
            return 0
        payloads: list[Payload] = [LabelAttributesSet(uid=uid, attributes=dict(new)) for uid, new in missing.items()]
        # retried if the frame was changed since it was read
        with suppress(StaleRevisionError):
            context = WriteContext(revision, author, Source.IMPORTED)
            project.log.append_to_frames([FramePart(frame_id, payloads, context)], action)
            return sum(map(len, missing.values()))
