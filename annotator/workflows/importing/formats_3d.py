"""Reads 3D boxes in each format as a `LabelSet`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.formats.argoverse import ANNOTATIONS, read_argoverse
from annotator.formats.attributes import Values
from annotator.formats.box_csv import read_upright_boxes
from annotator.formats.boxes_json import boxes_file, each_frame
from annotator.formats.kitti.box_rows import label_frame
from annotator.formats.kitti.label_folders import each_kitti_frame, read_kitti_shifts
from annotator.formats.kitti.tracking_folder import read_kitti_tracks
from annotator.formats.labelcloud import LabelCloudFrame, read_labelcloud
from annotator.formats.nuscenes import NuScenesBox, is_seen, read_nuscenes, read_results
from annotator.formats.openlabel import OpenLabelBox, OpenLabelFrame, read_openlabel
from annotator.formats.packed_truths import PackedTruths
from annotator.formats.rcv import read_rcv
from annotator.formats.sunrgbd.labels import read_extracted_folder
from annotator.formats.sunrgbd.meta_table import read_meta
from annotator.formats.sunrgbd.upright_depth import upright_frame
from annotator.formats.sustechpoints import SustechFrame, read_sustechpoints
from annotator.project import REVIEWED, Project
from annotator.recordings.argoverse.log import ArgoverseLog
from annotator.recordings.look_around import LookAround
from annotator.recordings.nuscenes.recording import NuScenes
from annotator.recordings.sunrgbd.calibration import read_extracted_calibration
from annotator.types import Frame, Label, ReviewState, Truth
from annotator.types.errors import FormatError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing.label_set import LeftOut, ScoreRange


def _with_confidences(truths: Sequence[Truth], scores: ScoreRange | None) -> list[Truth]:
    """Labels keep scores only if all of the dataset are in 0..1, as confidences are."""
    confident = scores is None or scores.are_confidences
    return list(truths) if confident else [replace(truth, score=None) for truth in truths]


def _lost(objects: Sequence[Truth] | Sequence[OpenLabelBox], scores: ScoreRange | None) -> int:
    """Number of scores that `_with_confidences` leaves out."""
    confident = scores is None or scores.are_confidences
    return 0 if confident else sum(each.score is not None for each in objects)


@dataclass(frozen=True)
class RcvLabels:
    """Accepted and edited labels; proposals and rejected boxes are left out."""

    path: Path
    labels: dict[str, tuple[Label, ...]]
    values: Mapping[str, Values] = field(default_factory=dict)

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.labels)

    def values_of_boxes(self, name: str) -> Sequence[Values]:
        return [each.attributes for each in self.labels[name]]

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        return [_truth(label) for label in self.labels[name] if label.state in REVIEWED]

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

    def classes(self, name: str) -> list[str]:
        return [each.label for each in self.labels[name] if each.state is not ReviewState.REJECTED]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        return [_truth(label) for label in self.labels[name] if label.state is not ReviewState.REJECTED]


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
    values = {name: values for name, _, values in frames}
    return RcvLabels(path, {name: labels for name, labels, _ in frames}, values)


@dataclass(frozen=True)
class KittiLabels:
    """Labels in the frame of rectified camera 0.

    The transform to the camera frame comes from the dataset's calibration, else from the frame's recording. Without
    either, the labels are taken as being in the camera frame.

    Attributes:
        objects: objects by frame name, with their scores as in the file.
        shifts: shift from rectified camera 0 to the colour camera, metres, of frames with a calibration.
    """

    path: Path
    objects: PackedTruths
    shifts: Mapping[str, Float64[np.ndarray, "3"]]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.objects)

    @cached_property
    def scores(self) -> ScoreRange | None:
        return ScoreRange.of(self.objects.scores)

    def values_of_boxes(self, name: str) -> Sequence[Values]:
        return [each.attributes for each in self.objects[name]]

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        truths = self.suggested(name, lambda: frame)
        return _with_confidences(truths, self.scores)

    def classes(self, name: str) -> list[str]:
        return [each.label for each in self.objects[name]]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        shift = self.shifts.get(name)
        T = label_frame(read()) if shift is None else RigidTransform.from_translation(shift)
        truths = self.objects[name]
        return list(truths) if T is None else [replace(truth, box=truth.box.transformed(T)) for truth in truths]

    def left_out_of(self, name: str) -> LeftOut:
        return LeftOut(scores=_lost(self.objects[name], self.scores))


def kitti_labels(path: Path) -> KittiLabels:
    """Reads a folder of KITTI object labels. Raises FormatError as `each_kitti_frame` and `read_kitti_shifts`."""
    return KittiLabels(path, PackedTruths(each_kitti_frame(path)), read_kitti_shifts(path))


def kitti_tracking_labels(path: Path) -> KittiLabels:
    """Reads KITTI tracking labels of whole sequences. Raises FormatError as `read_kitti_tracks`."""
    objects, shifts = read_kitti_tracks(path)
    return KittiLabels(path, PackedTruths(objects.items()), shifts)


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

    scores = None

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        return self.suggested(name, lambda: frame)

    def classes(self, name: str) -> list[str]:
        return [each.label for each in self.objects[name]]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        T = self.poses[name] if name in self.poses else upright_frame(read())
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
    """Accepted and edited boxes, and boxes without a review state; others are left out."""

    path: Path
    by_frame: Mapping[str, OpenLabelFrame]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.by_frame)

    @cached_property
    def scores(self) -> ScoreRange | None:
        return ScoreRange.of(box.score for each in self.by_frame.values() for box in each.boxes)

    def values_of_boxes(self, name: str) -> Sequence[Values]:
        return [each.attributes for each in self.by_frame[name].boxes]

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        boxes = [each for each in self.by_frame[name].boxes if _is_imported(each)]
        truths = self._truths(name, boxes, lambda: frame)
        return _with_confidences(truths, self.scores)

    def classes(self, name: str) -> list[str]:
        return [each.label for each in self._suggested(name)]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        return self._truths(name, self._suggested(name), read)

    def _suggested(self, name: str) -> list[OpenLabelBox]:
        return [each for each in self.by_frame[name].boxes if each.state is not ReviewState.REJECTED]

    def _truths(self, name: str, boxes: Sequence[OpenLabelBox], read: Callable[[], Frame]) -> list[Truth]:
        T = None if self.by_frame[name].of_camera else read().T_camera_label
        return [
            Truth(
                each.label,
                each.box if T is None else each.box.transformed(T),
                each.track_id,
                each.score,
                box_kind=each.box_kind,
                attributes=each.attributes,
                said=each.said if T is None else tuple(one.transformed(T) for one in each.said),
            )
            for each in boxes
        ]

    def values_of(self, name: str) -> Values:
        return self.by_frame[name].attributes

    def left_out_of(self, name: str) -> LeftOut:
        boxes = self.by_frame[name].boxes
        imported = [each for each in boxes if _is_imported(each)]
        rejected = len(boxes) - len(self._suggested(name))
        return LeftOut(len(boxes) - len(imported), rejected, _lost(imported, self.scores))


def _is_imported(box: OpenLabelBox) -> bool:
    return box.state is None or box.state in REVIEWED


def openlabel_labels(path: Path) -> OpenLabelLabels:
    """Reads OpenLABEL documents.

    Raises FormatError: not an OpenLABEL document, or one that does not follow the standard.
    """
    return OpenLabelLabels(path, read_openlabel(path))


@dataclass(frozen=True)
class LabelCloudLabels:
    """Boxes in the frames of their clouds; transformed to the camera by the dataset's calibration, else the frame's."""

    path: Path
    by_frame: Mapping[str, LabelCloudFrame]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.by_frame)

    scores = None

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        return self.suggested(name, lambda: frame)

    def classes(self, name: str) -> list[str]:
        return [label for label, _ in self.by_frame[name].boxes]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        each = self.by_frame[name]
        T = read().T_camera_label if each.T_camera_cloud is None else each.T_camera_cloud
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

    scores = None

    def values_of_boxes(self, name: str) -> Sequence[Values]:
        return [each.attributes for each in self.by_frame[name]]

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        return self.suggested(name, lambda: frame)

    def classes(self, name: str) -> list[str]:
        return [each.label for each in self.by_frame[name]]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        return [Truth(each.label, each.box, each.track_id, attributes=each.attributes) for each in self.by_frame[name]]

    def left_out_of(self, name: str) -> LeftOut:
        return LeftOut()


def nuscenes_labels(path: Path) -> NuScenesLabels | NuScenesResults:
    """Reads a folder of nuScenes tables, or a file of results.

    Raises FormatError: neither, or rows that do not follow the schema.
    """
    if path.is_file():
        return NuScenesResults(path, PackedTruths(read_results(path)))
    return NuScenesLabels(path, read_nuscenes(path))


@dataclass(frozen=True)
class _SampleBoxes:
    """Boxes around a vehicle, of which each camera's frame gets those that its image shows.

    Attributes:
        samples: objects by their sample, in the frame of the recordings' own labels.
        places: the sample of each of a project's frames, by "RECORDING/KEY"; see `FoundInProject`.
    """

    path: Path
    samples: PackedTruths
    places: Mapping[str, str] = field(default_factory=dict)
    # the places of the boxes that are in an image, by sample
    _seen: defaultdict[str, set[int]] = field(default_factory=lambda: defaultdict(set), init=False)

    @property
    def frames(self) -> Sequence[str]:
        found = set(self.places.values())
        return (*self.places, *(sample for sample in self.samples if sample not in found))

    @cached_property
    def scores(self) -> ScoreRange | None:
        return ScoreRange.of(self.samples.scores)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        return _with_confidences(self.suggested(name, lambda: frame), self.scores)

    def values_of_boxes(self, name: str) -> Sequence[Values]:
        return [each.attributes for each in self.samples[self.places.get(name, name)]]

    def classes(self, name: str) -> list[str]:
        return [each.label for each in self.samples[self.places.get(name, name)]]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        frame = read()
        K, size = frame.camera.matrix, (frame.camera.width_px, frame.camera.height_px)
        sample = self.places.get(name, name)
        truths = self.samples[sample]
        if (T := frame.T_camera_label) is not None:
            truths = tuple(replace(truth, box=truth.box.transformed(T)) for truth in truths)
        seen = [place for place, truth in enumerate(truths) if is_seen(truth.box, K, *size)]
        self._seen[sample].update(seen)
        return [truths[place] for place in seen]

    def unseen(self) -> int:
        return sum(len(self.samples[sample]) - len(seen) for sample, seen in self._seen.items())

    def left_out_of(self, name: str) -> LeftOut:
        return LeftOut(scores=_lost(self.samples[self.places.get(name, name)], self.scores))


class NuScenesResults(_SampleBoxes):
    """The boxes of a detector or tracker, in the global frame, by the token of their sample."""

    def in_project(self, project: Project) -> NuScenesResults:
        """Returns the boxes by the project's frames: those of each camera of the samples' recordings."""
        source, places = FrameSource(project), dict[str, str]()
        for stored in project.recordings.all():
            if stored.format not in (NuScenes.format, LookAround.format):
                continue
            recording = source.recording(stored.id)
            base = recording.base if isinstance(recording, LookAround) else recording
            if isinstance(base, NuScenes):
                samples = {key: base.sample(key) for key in base.keys}
                found = {f"{stored.name}/{key}": each for key, each in samples.items() if each is not None}
                places |= {name: each for name, each in found.items() if each in self.samples}
        if not places:
            problem = (
                f"the project has none of its samples ({len(self.samples)}); add their scenes to the project first"
            )
            raise FormatError(self.path, problem)
        return replace(self, places=places)


class ArgoverseLabels(_SampleBoxes):
    """The annotations of an Argoverse 2 log, in the ego frame, by the time of their sweep."""

    def in_project(self, project: Project) -> ArgoverseLabels:
        """Returns the boxes by the project's frames: those of each camera of the log."""
        names = {
            stored.id: stored.name
            for stored in project.recordings.all()
            if stored.format in (ArgoverseLog.format, LookAround.format)
        }
        frames = project.frames.of(tuple(names))
        places = {f"{names[each.recording_id]}/{each.key}": each.key for each in frames if each.key in self.samples}
        if not places:
            problem = f"the project has none of its sweeps ({len(self.samples)}); add their log to the project first"
            raise FormatError(self.path, problem)
        return replace(self, places=places)


def argoverse_labels(path: Path) -> ArgoverseLabels:
    """Reads `annotations.feather`, or that of a log. Raises as `read_argoverse`."""
    file = path / ANNOTATIONS if path.is_dir() else path
    sweeps = (
        (str(time_ns), [Truth(each.label, each.box, each.track) for each in boxes])
        for time_ns, boxes in read_argoverse(file).items()
    )
    return ArgoverseLabels(path, PackedTruths(sweeps))


@dataclass(frozen=True)
class BoxesLabels:
    """The content of a `boxes.json` file, in the camera frame."""

    path: Path
    boxes: PackedTruths

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.boxes)

    @cached_property
    def scores(self) -> ScoreRange | None:
        return ScoreRange.of(self.boxes.scores)

    def values_of_boxes(self, name: str) -> Sequence[Values]:
        return [each.attributes for each in self.boxes[name]]

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        return _with_confidences(self.boxes[name], self.scores)

    def classes(self, name: str) -> list[str]:
        return [each.label for each in self.boxes[name]]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        return list(self.boxes[name])

    def left_out_of(self, name: str) -> LeftOut:
        return LeftOut(scores=_lost(self.boxes[name], self.scores))


def boxes_labels(path: Path) -> BoxesLabels:
    """Reads a `boxes.json` file, or that of a folder. Raises FormatError: missing, or not valid."""
    return BoxesLabels(path, PackedTruths(each_frame(boxes_file(path))))


class BoxCsvLabels(BoxesLabels):
    """The rows of a CSV file of boxes, in upright depth."""

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        return _with_confidences(self.suggested(name, lambda: frame), self.scores)

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        T = upright_frame(read())
        return [replace(truth, box=truth.box.transformed(T)) for truth in self.boxes[name]]


def box_csv_labels(path: Path) -> BoxCsvLabels:
    """Reads a CSV file of boxes. Raises FormatError as `read_upright_boxes`."""
    return BoxCsvLabels(path, PackedTruths(read_upright_boxes(path).items()))


# Two cameras with matrices that differ less, as a share of the focal length, are the same.
SAME_CAMERA = 0.01


@dataclass(frozen=True)
class SustechLabels:
    """Boxes in the frames of their clouds.

    They are transformed to the camera by the scene's calibration of the camera that the frame has. Without one, they
    are in the frame of the recording's own labels: for a folder of clouds, that of the clouds.
    """

    path: Path
    by_frame: Mapping[str, SustechFrame]
    scores = None

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.by_frame)

    def values_of_boxes(self, name: str) -> Sequence[Values]:
        return [each.attributes for each in self.by_frame[name].objects]

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        return self.suggested(name, lambda: frame)

    def classes(self, name: str) -> list[str]:
        return [each.label for each in self.by_frame[name].objects]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        each = self.by_frame[name]
        T = each.cameras[0].T_camera_cloud if each.is_export else _sustech_pose(each, read())
        return [one if T is None else replace(one, box=one.box.transformed(T)) for one in each.objects]

    def left_out_of(self, name: str) -> LeftOut:
        return LeftOut()


def _sustech_pose(labels: SustechFrame, frame: Frame) -> RigidTransform | None:
    K = frame.camera.matrix
    off = [float(np.abs(camera.K - K).max() / K[0, 0]) for camera in labels.cameras]
    best = int(np.argmin(off)) if off else None
    return frame.T_camera_label if best is None or off[best] > SAME_CAMERA else labels.cameras[best].T_camera_cloud


def sustechpoints_labels(path: Path) -> SustechLabels:
    """Reads SUSTechPOINTS' labels. Raises FormatError: as `read_sustechpoints`."""
    return SustechLabels(path, read_sustechpoints(path))
