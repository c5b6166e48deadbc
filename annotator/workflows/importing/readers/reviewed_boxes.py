"""The formats whose boxes have a review state: `rcv` and OpenLABEL."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.formats.attributes import Values
from annotator.formats.openlabel import OpenLabelBox, OpenLabelFrame, read_openlabel
from annotator.formats.rcv import read_rcv
from annotator.formats.units import AngleUnit
from annotator.project import REVIEWED
from annotator.types import Frame, Label, ReviewState, Truth
from annotator.workflows.importing.label_set import LeftOut, ScoreRange
from annotator.workflows.importing.readers.placed_boxes import (
    lost_scores,
    moved_in_world,
    transformed,
    with_confidences,
)


@dataclass(frozen=True)
class RcvLabels:
    """Accepted and edited labels; proposals and rejected boxes are left out."""

    path: Path
    labels: dict[str, tuple[Label, ...]]
    values: Mapping[str, Values] = field(default_factory=dict)
    poses: Mapping[str, RigidTransform | None] = field(default_factory=dict)

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.labels)

    def values_of_boxes(self, name: str) -> Sequence[Values]:
        return [each.attributes for each in self.labels[name]]

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        return self._truths(name, [label for label in self.labels[name] if label.state in REVIEWED], lambda: frame)

    def values_of(self, name: str) -> Values:
        return self.values.get(name, {})

    def left_out_of(self, name: str) -> LeftOut:
        states = [label.state for label in self.labels[name]]
        return LeftOut(
            not_reviewed=sum(state not in REVIEWED for state in states), rejected=states.count(ReviewState.REJECTED)
        )

    @property
    def scores(self) -> ScoreRange | None:
        return ScoreRange.of(label.score for labels in self.labels.values() for label in labels)

    @property
    def sizes_m(self) -> Iterable[Float64[np.ndarray, "3"]]:
        return (label.box.size_m for labels in self.labels.values() for label in labels)

    def classes(self, name: str) -> list[str]:
        return [each.label for each in self.labels[name] if each.state is not ReviewState.REJECTED]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        labels = [label for label in self.labels[name] if label.state is not ReviewState.REJECTED]
        return self._truths(name, labels, read)

    def _truths(self, name: str, labels: Sequence[Label], read: Callable[[], Frame]) -> list[Truth]:
        return transformed([_truth(label) for label in labels], moved_in_world(self.poses.get(name), read))


def _truth(label: Label) -> Truth:
    return Truth(
        label.label,
        label.box,
        label.track_id,
        label.score,
        box_kind=label.box_kind,
        attributes=label.attributes,
        said=label.said,
    )


def rcv_labels(path: Path) -> RcvLabels:
    """Reads an `rcv` dataset.

    Raises FormatError: not an `rcv` dataset, or a label file that does not follow the format.
    """
    dataset = read_rcv(path)
    frames = [dataset.named_labels(i) for i in range(len(dataset))]
    values = {name: values for name, _, values, _ in frames}
    poses = {name: pose for name, *_, pose in frames}
    return RcvLabels(path, {name: labels for name, labels, *_ in frames}, values, poses)


@dataclass(frozen=True)
class OpenLabelLabels:
    """Accepted and edited boxes, and boxes without a review state; others are left out."""

    path: Path
    by_frame: Mapping[str, OpenLabelFrame]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.by_frame)

    @cached_property
    def scores(self) -> ScoreRange | None:
        return ScoreRange.of(box.score for each in self.by_frame.values() for box in each.boxes)

    @property
    def sizes_m(self) -> Iterable[Float64[np.ndarray, "3"]]:
        return (box.box.size_m for each in self.by_frame.values() for box in each.boxes)

    def values_of_boxes(self, name: str) -> Sequence[Values]:
        return [each.attributes for each in self.by_frame[name].boxes]

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        boxes = [each for each in self.by_frame[name].boxes if _is_imported(each)]
        truths = self._truths(name, boxes, lambda: frame)
        return with_confidences(truths, self.scores)

    def classes(self, name: str) -> list[str]:
        return [each.label for each in self._suggested(name)]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        return self._truths(name, self._suggested(name), read)

    def _suggested(self, name: str) -> list[OpenLabelBox]:
        return [each for each in self.by_frame[name].boxes if each.state is not ReviewState.REJECTED]

    def _truths(self, name: str, boxes: Sequence[OpenLabelBox], read: Callable[[], Frame]) -> list[Truth]:
        own = self.by_frame[name]
        T = moved_in_world(own.T_world_sensor, read) if own.of_camera else read().T_camera_label
        truths = [
            Truth(
                each.label,
                each.box,
                each.track_id,
                each.score,
                box_kind=each.box_kind,
                attributes=each.attributes,
                said=each.said,
            )
            for each in boxes
        ]
        return transformed(truths, T)

    def values_of(self, name: str) -> Values:
        return self.by_frame[name].attributes

    def left_out_of(self, name: str) -> LeftOut:
        boxes = self.by_frame[name].boxes
        imported = [each for each in boxes if _is_imported(each)]
        rejected = len(boxes) - len(self._suggested(name))
        return LeftOut(len(boxes) - len(imported), rejected, lost_scores(imported, self.scores))


def _is_imported(box: OpenLabelBox) -> bool:
    return box.state is None or box.state in REVIEWED


def openlabel_labels(path: Path, angles: AngleUnit | None = None) -> OpenLabelLabels:
    """Reads OpenLABEL documents.

    Raises FormatError: not an OpenLABEL document, or one that does not follow the standard.
    """
    return OpenLabelLabels(path, read_openlabel(path, angles))
