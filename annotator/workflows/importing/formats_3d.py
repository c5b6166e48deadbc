"""Reads 3D boxes in each format as a `LabelSet`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.formats.kitti.box_rows import label_frame
from annotator.formats.kitti.label_folders import Frames, read_kitti_labels, read_kitti_shifts
from annotator.formats.kitti.tracking_folder import read_kitti_tracks
from annotator.formats.labelcloud import LabelCloudFrame, read_labelcloud
from annotator.formats.nuscenes import NuScenesBox, read_nuscenes
from annotator.formats.openlabel import OpenLabelBox, OpenLabelFrame, read_openlabel
from annotator.formats.rcv import read_rcv
from annotator.formats.sunrgbd.labels import read_extracted_folder
from annotator.formats.sunrgbd.meta_table import read_meta
from annotator.formats.sunrgbd.upright_depth import upright_frame
from annotator.project import REVIEWED
from annotator.recordings.sunrgbd.calibration import read_extracted_calibration
from annotator.types import Frame, Label, Truth
from annotator.workflows.importing.label_set import LeftOut, are_confidences


@dataclass(frozen=True)
class RcvLabels:
    """Accepted and edited labels; proposals and rejected boxes are left out."""

    path: Path
    labels: dict[str, tuple[Label, ...]]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.labels)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        reviewed = (label for label in self.labels[name] if label.state in REVIEWED)
        return [Truth(one.label, one.box, one.track_id, one.score, box_kind=one.box_kind) for one in reviewed]

    def left_out_of(self, name: str) -> LeftOut:
        return LeftOut(not_reviewed=sum(label.state not in REVIEWED for label in self.labels[name]))


def rcv_labels(path: Path) -> RcvLabels:
    """Reads an `rcv` dataset.

    Raises FormatError: not an `rcv` dataset, or a label file that does not follow the format.
    """
    dataset = read_rcv(path)
    return RcvLabels(path, dict(dataset.named_labels(i) for i in range(len(dataset))))


@dataclass(frozen=True)
class KittiLabels:
    """Labels in the frame of rectified camera 0.

    The transform to the camera frame comes from the dataset's calibration, else from the frame's recording. Without
    either, the labels are taken as being in the camera frame.

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

    def left_out_of(self, name: str) -> LeftOut:
        return LeftOut(scores=self.lost_scores.get(name, 0))


def kitti_labels(path: Path) -> KittiLabels:
    """Reads a folder of KITTI object labels. Raises FormatError as `read_kitti_labels` and `read_kitti_shifts`."""
    return _without_raw_scores(path, read_kitti_labels(path), read_kitti_shifts(path))


def _without_raw_scores(path: Path, objects: Frames, shifts: Mapping[str, Float64[np.ndarray, "3"]]) -> KittiLabels:
    """Returns the labels read from `path`; removes scores that are not confidences."""
    if are_confidences(truth.score for truths in objects.values() for truth in truths):
        return KittiLabels(path, objects, {}, shifts)
    lost = {name: sum(truth.score is not None for truth in truths) for name, truths in objects.items()}
    bare = {name: tuple(replace(truth, score=None) for truth in truths) for name, truths in objects.items()}
    return KittiLabels(path, bare, lost, shifts)


def kitti_tracking_labels(path: Path) -> KittiLabels:
    """Reads KITTI tracking labels of whole sequences. Raises FormatError as `read_kitti_tracks`."""
    return _without_raw_scores(path, *read_kitti_tracks(path))


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

    def left_out_of(self, name: str) -> LeftOut:
        return LeftOut()


def sunrgbd_labels(path: Path) -> SunLabels:
    """Reads SUN RGB-D labels: a folder in VoteNet's layout (upright boxes), or the data set's table (tilted boxes).

    Raises FormatError for invalid labels, FrameError for invalid calibrations.
    """
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


@dataclass(frozen=True)
class OpenLabelLabels:
    """Accepted and edited boxes, and boxes without a review state; others are left out.

    Attributes:
        scored: True if the scores are confidences in 0..1; otherwise they are left out.
    """

    path: Path
    by_frame: Mapping[str, OpenLabelFrame]
    scored: bool

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.by_frame)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        T = None if self.by_frame[name].of_camera else frame.T_camera_label
        return [
            Truth(
                each.label,
                each.box if T is None else each.box.transformed(T),
                each.track_id,
                each.score if self.scored else None,
                box_kind=each.box_kind,
            )
            for each in self.by_frame[name].boxes
            if _is_imported(each)
        ]

    def left_out_of(self, name: str) -> LeftOut:
        boxes = self.by_frame[name].boxes
        imported = [each for each in boxes if _is_imported(each)]
        lost = 0 if self.scored else sum(each.score is not None for each in imported)
        return LeftOut(len(boxes) - len(imported), lost)


def _is_imported(box: OpenLabelBox) -> bool:
    return box.state is None or box.state in REVIEWED


def openlabel_labels(path: Path) -> OpenLabelLabels:
    """Reads OpenLABEL documents.

    Raises FormatError: not an OpenLABEL document, or one that does not follow the standard.
    """
    frames = read_openlabel(path)
    return OpenLabelLabels(path, frames, are_confidences(box.score for each in frames.values() for box in each.boxes))


@dataclass(frozen=True)
class LabelCloudLabels:
    """Boxes in the frames of their clouds; transformed to the camera by the dataset's calibration, else the frame's."""

    path: Path
    by_frame: Mapping[str, LabelCloudFrame]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.by_frame)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        each = self.by_frame[name]
        T = frame.T_camera_label if each.T_camera_cloud is None else each.T_camera_cloud
        return [Truth(label, box if T is None else box.transformed(T)) for label, box in each.boxes]

    def left_out_of(self, name: str) -> LeftOut:
        return LeftOut()


def labelcloud_labels(path: Path) -> LabelCloudLabels:
    """Reads a labelCloud project.

    Raises FormatError: not a labelCloud project, or a label file that does not follow the format.
    """
    return LabelCloudLabels(path, read_labelcloud(path))


@dataclass(frozen=True)
class NuScenesLabels:
    """The annotations of every camera's images."""

    path: Path
    by_frame: Mapping[str, tuple[NuScenesBox, ...]]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.by_frame)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        return [Truth(each.label, each.box, each.track_id) for each in self.by_frame[name]]

    def left_out_of(self, name: str) -> LeftOut:
        return LeftOut()


def nuscenes_labels(path: Path) -> NuScenesLabels:
    """Reads nuScenes tables. Raises FormatError: no nuScenes tables, or rows that do not follow the schema."""
    return NuScenesLabels(path, read_nuscenes(path))
