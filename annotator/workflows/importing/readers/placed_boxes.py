"""Boxes that belong to one frame each; most formats have such."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.formats.attributes import Values
from annotator.formats.openlabel import OpenLabelBox
from annotator.formats.packed_truths import PackedTruths
from annotator.types import Frame, Truth
from annotator.workflows.importing.label_set import LeftOut, ScoreRange

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
