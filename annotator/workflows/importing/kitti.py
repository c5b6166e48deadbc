"""KITTI labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.formats.kitti.box_rows import label_frame
from annotator.formats.kitti.label_folders import Frames, read_kitti_labels, read_kitti_shifts
from annotator.types import Frame, Truth
from annotator.workflows.importing.label_set import LeftBehind, are_confidences


@dataclass(frozen=True)
class KittiLabels:
    """Labels in rectified camera 0: of the dataset's calibration, else of the frame's recording, else the camera.

    Attributes:
        objects: objects by frame name.
        lost_scores: number of scores per frame that were removed because they are not confidences.
        shifts: shift from rectified camera 0 to the colour camera, metres, of frames with a calibration.
    """

    path: Path
    objects: Frames
    lost_scores: Mapping[str, int]
    shifts: Mapping[str, Float64[np.ndarray, "3"]]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.objects)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        shift = self.shifts.get(name)
        T = label_frame(frame) if shift is None else RigidTransform.from_translation(shift)
        truths = self.objects[name]
        return list(truths) if T is None else [replace(truth, box=truth.box.transformed(T)) for truth in truths]

    def left_behind(self, name: str) -> LeftBehind:
        return LeftBehind(scores=self.lost_scores.get(name, 0))


def read(path: Path) -> KittiLabels:
    """Raises FormatError as `read_kitti_labels` and `read_kitti_shifts`."""
    return labels_of(path, read_kitti_labels(path), read_kitti_shifts(path))


def labels_of(path: Path, objects: Frames, shifts: Mapping[str, Float64[np.ndarray, "3"]]) -> KittiLabels:
    """Returns the labels read from `path`; removes scores that are not confidences."""
    if are_confidences(truth.score for truths in objects.values() for truth in truths):
        return KittiLabels(path, objects, {}, shifts)
    lost = {name: sum(truth.score is not None for truth in truths) for name, truths in objects.items()}
    bare = {name: tuple(replace(truth, score=None) for truth in truths) for name, truths in objects.items()}
    return KittiLabels(path, bare, lost, shifts)
