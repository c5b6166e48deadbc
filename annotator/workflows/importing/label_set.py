"""The interface of imported 3D boxes in any format."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.formats.attributes import Values
from annotator.formats.openlabel import OpenLabelBox
from annotator.formats.packed_truths import PackedTruths
from annotator.project import Project
from annotator.types import Frame, Truth
from annotator.types.label import AttributeValue


@dataclass(frozen=True)
class LeftOut:
    """What `LabelSet.truths` leaves out of a frame.

    Attributes:
        not_reviewed: number of proposed and rejected boxes.
        rejected: number of the rejected ones, which `ProposalSet.suggested` leaves out, too.
        scores: number of scores that are not confidences in 0..1.
        flat: number of 2D boxes without a 3D box.
    """

    not_reviewed: int = 0
    rejected: int = 0
    scores: int = 0
    flat: int = 0


@dataclass(frozen=True)
class ScoreRange:
    """The lowest and the highest score of a dataset."""

    low: float
    high: float

    @classmethod
    def of(cls, scores: Iterable[float | None]) -> ScoreRange | None:
        """Returns the range of the scores that are known; None if none is."""
        known = [score for score in scores if score is not None]
        return cls(min(known), max(known)) if known else None

    @property
    def are_confidences(self) -> bool:
        """True if all scores are in 0..1; otherwise they are raw values of a detector."""
        return self.low >= 0 and self.high <= 1

    def confidence(self, score: float | None) -> float | None:
        """Returns a score as a number in 0..1; raw values are scaled so that the range becomes 0..1."""
        if score is None or self.are_confidences:
            return score
        return 1.0 if self.high == self.low else (score - self.low) / (self.high - self.low)


@runtime_checkable
class LabelSet(Protocol):
    """The boxes of a dataset, read and checked as a whole before anything is stored."""

    @property
    def path(self) -> Path:
        """The file or folder that they were read from."""

    @property
    def frames(self) -> Sequence[str]:
        """Names of the labelled frames, including empty ones: "RECORDING/KEY", or only "KEY"."""

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        """Returns the objects of one of these frames, in the camera frame.

        Args:
            frame: the project's frame of that name; formats whose boxes are not in the camera frame use its
                `T_camera_label` or `up`.

        Raises:
            FormatError: the frame lacks what the format needs.
        """

    def values_of_boxes(self, name: str) -> Sequence[Mapping[str, AttributeValue]]:
        """Returns the values of the attributes of each box of one of these frames; no frame is read."""

    def left_out_of(self, name: str) -> LeftOut:
        """Returns what is left out of one of these frames, for the report."""


@runtime_checkable
class ProposalSet(LabelSet, Protocol):
    """The boxes of a dataset, also as proposals."""

    @property
    def scores(self) -> ScoreRange | None:
        """The range of the scores of all boxes, as in the files; None without any."""

    @property
    def sizes_m(self) -> Iterable[Float64[np.ndarray, "3"]]:
        """The size of each box, as `OrientedBox.size_m`."""

    def classes(self, name: str) -> list[str]:
        """Returns the classes of the boxes that `suggested` may return; no frame is read."""

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        """Returns the objects of one of these frames that nobody has rejected, with their scores as in the file.

        Args:
            read: reads the project's frame, which takes long; called only if the format needs it.

        Raises:
            FormatError: as `truths`.
        """


@runtime_checkable
class FoundInProject(Protocol):
    """A dataset whose frames only the recordings of a project can tell."""

    def in_project(self, project: Project) -> ProposalSet:
        """Returns the boxes by the project's frames.

        Raises:
            FormatError: none of them is in the project.
            RecordingError: a recording has been moved.
        """


def classes_of(project: Project, dataset: ProposalSet) -> set[str]:
    """Returns the classes of all boxes of a dataset; no frame is read. Raises as `FoundInProject.in_project`."""
    found = dataset.in_project(project) if isinstance(dataset, FoundInProject) else dataset
    return {label for name in found.frames for label in found.classes(name)}


@runtime_checkable
class HasFrameValues(Protocol):
    """A `LabelSet` whose frames have attributes."""

    def values_of(self, name: str) -> Mapping[str, AttributeValue]:
        """Returns the values of a frame."""


@runtime_checkable
class HasUnseen(Protocol):
    """A `LabelSet` whose boxes belong to several images, and not all of them are in one."""

    def unseen(self) -> int:
        """Returns the number of boxes that are in none of the images whose frames have been read."""


Pose = Callable[[str, Callable[[], Frame]], RigidTransform | None]
"""Transform of the boxes of a frame, by its name, to its camera; None: they are in its frame already. The second
argument reads the project's frame, which takes long."""


@dataclass(frozen=True)
class PlacedBoxes:
    """Boxes of which none was rejected.

    Attributes:
        objects: objects by frame name, with their scores as in the file.
        pose: None: all are in the camera frame.
        flat: number of 2D boxes without a 3D box, by frame name.
    """

    path: Path
    objects: PackedTruths
    pose: Pose | None = None
    flat: Mapping[str, int] = field(default_factory=dict)

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.objects)

    @cached_property
    def scores(self) -> ScoreRange | None:
        return ScoreRange.of(self.objects.scores)

    @property
    def sizes_m(self) -> Iterable[Float64[np.ndarray, "3"]]:
        return self.objects.sizes_m

    def values_of_boxes(self, name: str) -> Sequence[Values]:
        return [each.attributes for each in self.objects[name]]

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        return with_confidences(self.suggested(name, lambda: frame), self.scores)

    def classes(self, name: str) -> list[str]:
        return [each.label for each in self.objects[name]]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        return transformed(self.objects[name], None if self.pose is None else self.pose(name, read))

    def left_out_of(self, name: str) -> LeftOut:
        return LeftOut(scores=lost_scores(self.objects[name], self.scores), flat=self.flat.get(name, 0))


def moved_in_world(T_world_there: RigidTransform | None, read: Callable[[], Frame]) -> RigidTransform | None:
    """Returns the transform from the camera of an exported frame to that of the project's frame.

    They stand at different places of one map if the recording was added with another origin before.

    Args:
        T_world_there: where the dataset says that its camera (or other frame of reference) is; None if it does not.
        read: reads the project's frame.

    Returns:
        None if the dataset or the project does not know the place: then both are taken as one.
    """
    T_world_here = None if T_world_there is None else read().T_world_camera
    return None if T_world_there is None or T_world_here is None else T_world_here.inv() * T_world_there


def transformed(truths: Sequence[Truth], T: RigidTransform | None) -> list[Truth]:
    """Returns the objects with their boxes transformed; None: as they are."""
    if T is None:
        return list(truths)
    return [
        replace(truth, box=truth.box.transformed(T), said=tuple(said.transformed(T) for said in truth.said))
        for truth in truths
    ]


def with_confidences(truths: Sequence[Truth], scores: ScoreRange | None) -> list[Truth]:
    """Labels keep scores only if all of the dataset are in 0..1, as confidences are."""
    confident = scores is None or scores.are_confidences
    return list(truths) if confident else [replace(truth, score=None) for truth in truths]


def lost_scores(objects: Sequence[Truth] | Sequence[OpenLabelBox], scores: ScoreRange | None) -> int:
    """Number of scores that `with_confidences` leaves out."""
    confident = scores is None or scores.are_confidences
    return 0 if confident else sum(each.score is not None for each in objects)
