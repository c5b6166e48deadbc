"""SUN RGB-D labels: a folder in VoteNet's layout (upright boxes), or the data set's table (boxes may be tilted)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from scipy.spatial.transform import RigidTransform

from annotator.formats.sunrgbd.labels import read_extracted_folder
from annotator.formats.sunrgbd.meta_table import read_meta
from annotator.formats.sunrgbd.upright_depth import upright_frame
from annotator.recordings.sunrgbd.calibration import read_extracted_calibration
from annotator.types import Frame, Truth
from annotator.workflows.importing.label_set import LeftBehind


@dataclass(frozen=True)
class SunLabels:
    """Labels in upright depth.

    Attributes:
        objects: objects by frame name.
        poses: T_camera_upright of frames with a calibration in the dataset; for others it follows from the frame.
    """

    path: Path
    objects: dict[str, tuple[Truth, ...]]
    poses: dict[str, RigidTransform]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.objects)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        T = self.poses[name] if name in self.poses else upright_frame(frame)
        return [replace(truth, box=truth.box.transformed(T)) for truth in self.objects[name]]

    def left_behind(self, name: str) -> LeftBehind:
        return LeftBehind()


def read(path: Path) -> SunLabels:
    """Raises FormatError for invalid labels, FrameError for invalid calibrations."""
    if path.suffix == ".mat":
        frames = read_meta(path)
        return SunLabels(path, {f.name: f.truths for f in frames}, {f.name: f.T_camera_upright for f in frames})
    labelled = read_extracted_folder(path)
    calibrated = {
        name: read_extracted_calibration(each.calibration).T_camera_upright
        for name, each in labelled.items()
        if each.calibration is not None and each.calibration.is_file()
    }
    return SunLabels(path, {name: each.truths for name, each in labelled.items()}, calibrated)
