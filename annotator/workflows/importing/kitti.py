"""KITTI labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.formats.kitti_labels import Frames, read_kitti_labels, read_kitti_shifts
from annotator.formats.kitti_row import label_frame
from annotator.types import Frame, Truth


@dataclass(frozen=True)
class KittiLabels:
    """Labels in rectified camera 0: as their dataset has it, else as the frame's recording, else the colour camera.

    Attributes:
        shifts: from rectified camera 0 to the colour camera, metres, where the dataset says it.
    """

    path: Path
    objects: Frames
    shifts: Mapping[str, Float64[np.ndarray, "3"]]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.objects)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        shift = self.shifts.get(name)
        T = label_frame(frame) if shift is None else RigidTransform.from_translation(shift)
        found = self.objects[name]
        return list(found) if T is None else [replace(truth, box=truth.box.transformed(T)) for truth in found]


def read(path: Path) -> KittiLabels:
    """Raises FormatError as `read_kitti_labels` and `read_kitti_shifts`."""
    return KittiLabels(path, read_kitti_labels(path), read_kitti_shifts(path))
