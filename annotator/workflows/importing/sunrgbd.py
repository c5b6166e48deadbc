"""SUN RGB-D's labels: a folder in VoteNet's layout (upright boxes), or the data set's table (boxes that may lean)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from scipy.spatial.transform import RigidTransform

from annotator.formats.sunrgbd_meta import read_meta
from annotator.formats.sunrgbd_sets import read_extracted_folder
from annotator.formats.sunrgbd_upright import upright_frame
from annotator.recordings.sunrgbd_calib import read_extracted_calibration
from annotator.types import Frame, Truth
from annotator.workflows.importing.label_set import LeftBehind


@dataclass(frozen=True)
class SunLabels:
    """Labels in upright depth.

    Attributes:
        objects: of each frame.
        poses: T_camera_upright of the frames whose dataset says it; for the others it is that of our frame.
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
    """Raises FormatError (labels) or FrameError (calibration): they do not follow the format."""
    if path.suffix == ".mat":
        frames = read_meta(path)
        return SunLabels(path, {f.name: f.truths for f in frames}, {f.name: f.T_camera_upright for f in frames})
    found = read_extracted_folder(path)
    calibrated = {
        name: read_extracted_calibration(each.calibration).T_camera_upright
        for name, each in found.items()
        if each.calibration is not None and each.calibration.is_file()
    }
    return SunLabels(path, {name: each.truths for name, each in found.items()}, calibrated)
