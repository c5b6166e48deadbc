"""KITTI labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from annotator.formats.kitti_labels import Frames, read_kitti_labels
from annotator.formats.kitti_row import label_frame
from annotator.types import Frame, Truth


@dataclass(frozen=True)
class KittiLabels:
    """Labels in rectified camera 0: of the frame itself where its recording has such labels, else its colour camera."""

    path: Path
    objects: Frames

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.objects)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        T = label_frame(frame)
        found = self.objects[name]
        return list(found) if T is None else [replace(truth, box=truth.box.transformed(T)) for truth in found]


def read(path: Path) -> KittiLabels:
    """Raises FormatError as `read_kitti_labels`."""
    return KittiLabels(path, read_kitti_labels(path))
