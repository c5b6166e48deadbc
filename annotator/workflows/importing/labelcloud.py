"""Labels of a labelCloud project."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from annotator.formats.labelcloud import LabelCloudFrame, read_labelcloud
from annotator.types import Frame, Truth
from annotator.workflows.importing.label_set import LeftBehind


@dataclass(frozen=True)
class LabelCloudLabels:
    """Boxes in the frames of their clouds; moved to the camera by the dataset's calibration, else the frame's."""

    path: Path
    by_frame: Mapping[str, LabelCloudFrame]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.by_frame)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        each = self.by_frame[name]
        T = frame.T_camera_label if each.T_camera_cloud is None else each.T_camera_cloud
        return [Truth(label, box if T is None else box.transformed(T)) for label, box in each.boxes]

    def left_behind(self, name: str) -> LeftBehind:
        return LeftBehind()


def read(path: Path) -> LabelCloudLabels:
    """Raises FormatError: not a labelCloud project, or a label file that does not follow the format."""
    return LabelCloudLabels(path, read_labelcloud(path))
