"""Reads 3D boxes in each format as a `LabelSet`, for imports, checks and the labels beside recordings.

A new format needs a row in `annotator.formats.table`, and an entry in `READERS`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from annotator.formats.argoverse import ANNOTATIONS, read_argoverse
from annotator.formats.box_csv import read_upright_boxes
from annotator.formats.boxes_json import boxes_file, each_frame
from annotator.formats.kitti_objects import KittiRows, each_kitti_frame, read_kitti_shifts
from annotator.formats.kitti_rows import label_frame
from annotator.formats.kitti_tracking import read_kitti_tracks
from annotator.formats.labelcloud import read_labelcloud
from annotator.formats.nuscenes import is_seen, read_nuscenes, read_results, read_world_poses
from annotator.formats.openlabel import read_openlabel
from annotator.formats.packed_truths import PackedTruths
from annotator.formats.rcv import read_rcv
from annotator.formats.reading import OnFault, raise_fault
from annotator.formats.sunrgbd import read_extracted_folder, read_meta, upright_frame
from annotator.formats.sustechpoints import SceneCamera, read_sustechpoints
from annotator.formats.table import FORMATS, BoxFormat
from annotator.formats.units import Angles, AngleUnit, Lengths
from annotator.project import Project
from annotator.recordings.argoverse import ArgoverseLog
from annotator.recordings.look_around import LookAround
from annotator.recordings.nuscenes import NuScenes
from annotator.recordings.sunrgbd import read_extracted_calibration
from annotator.types import Frame, Label, Truth
from annotator.types.errors import ConfigError, FormatError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing.label_set import LabelSet, PlacedBoxes, Pose, moved_in_world, transformed

# Two cameras with matrices that differ less, as a share of the focal length, are the same.
SAME_CAMERA = 0.01


def boxes_labels(path: Path) -> PlacedBoxes:
    """Reads a `boxes.json` file, or that of a folder."""
    return PlacedBoxes(path, PackedTruths(each_frame(boxes_file(path))))


def kitti_labels(path: Path, angles: AngleUnit | None = None) -> PlacedBoxes:
    """Reads a folder of KITTI object labels."""
    found = KittiRows(Angles(angles))
    objects = PackedTruths(each_kitti_frame(path, found))
    return PlacedBoxes(path, objects, _from_rectified(read_kitti_shifts(path)), found.flat)


def kitti_tracking_labels(path: Path, angles: AngleUnit | None = None) -> PlacedBoxes:
    """Reads KITTI tracking labels of whole sequences."""
    found = KittiRows(Angles(angles))
    objects, shifts = read_kitti_tracks(path, found)
    return PlacedBoxes(path, PackedTruths(objects.items()), _from_rectified(shifts), found.flat)


def _from_rectified(shifts: Mapping[str, np.ndarray]) -> Pose:
    """From the frame of rectified camera 0, by the dataset's calibration, else that of the frame's recording. Without
    either, the labels are taken as being in the camera frame.

    Args:
        shifts: shift from rectified camera 0 to the colour camera, (3,) metres, of frames with a calibration.
    """

    def pose(name: str, read: Callable[[], Frame]) -> RigidTransform | None:
        shift = shifts.get(name)
        return label_frame(read()) if shift is None else RigidTransform.from_translation(shift)

    return pose


def sunrgbd_labels(path: Path) -> PlacedBoxes:
    """Reads SUN RGB-D labels: a folder in VoteNet's layout (upright boxes), or the data set's table (tilted boxes)."""
    if path.suffix == ".mat":
        frames = read_meta(path)
        poses = {each.name: each.T_camera_upright for each in frames}
        return PlacedBoxes(path, PackedTruths((each.name, each.truths) for each in frames), _from_upright(poses))
    labelled = read_extracted_folder(path)
    poses = {
        name: read_extracted_calibration(each.calibration).T_camera_upright
        for name, each in labelled.items()
        if each.calibration is not None and each.calibration.is_file()
    }
    objects = PackedTruths((name, each.truths) for name, each in labelled.items())
    return PlacedBoxes(path, objects, _from_upright(poses))


def box_csv_labels(path: Path, angles: AngleUnit | None = None) -> PlacedBoxes:
    """Reads a CSV file of boxes in upright depth."""
    return PlacedBoxes(path, PackedTruths(read_upright_boxes(path, angles).items()), _from_upright({}))


def _from_upright(poses: Mapping[str, RigidTransform]) -> Pose:
    """From upright depth.

    Args:
        poses: T_camera_upright of frames with a calibration in the dataset; for others it follows from the frame.
    """

    def pose(name: str, read: Callable[[], Frame]) -> RigidTransform:
        return poses[name] if name in poses else upright_frame(read())

    return pose


def labelcloud_labels(path: Path, angles: AngleUnit | None = None, on_fault: OnFault = raise_fault) -> PlacedBoxes:
    """Reads a labelCloud project, boxes in the frames of their clouds; transformed to the camera by the dataset's
    calibration, else the frame's.
    """
    frames = read_labelcloud(path, on_fault, angles)
    poses = {name: each.T_camera_cloud for name, each in frames.items()}

    def pose(name: str, read: Callable[[], Frame]) -> RigidTransform | None:
        return read().T_camera_label if (T := poses[name]) is None else T

    return PlacedBoxes(path, PackedTruths((name, each.objects) for name, each in frames.items()), pose)


def nuscenes_tables(path: Path, on_fault: OnFault = raise_fault) -> PlacedBoxes:
    """Reads the annotations of every camera's images in a folder of nuScenes tables."""
    objects = PackedTruths(read_nuscenes(path, on_fault).items())
    poses = read_world_poses(path)
    return PlacedBoxes(path, objects, lambda name, read: moved_in_world(poses.get(name), read))


def sustechpoints_labels(path: Path, angles: AngleUnit | None = None) -> PlacedBoxes:
    """Reads SUSTechPOINTS' labels, which are in the frames of their clouds.

    They are transformed to the camera by the scene's calibration of the camera that the frame has. Without one, they
    are in the frame of the recording's own labels: for a folder of clouds, that of the clouds.
    """
    frames = read_sustechpoints(path, angles)
    cameras = {name: (each.cameras, each.is_export, each.T_world_cloud) for name, each in frames.items()}

    def pose(name: str, read: Callable[[], Frame]) -> RigidTransform | None:
        of_scene, is_export, T_world_cloud = cameras[name]
        if not is_export:
            return _by_camera(of_scene, read())
        return of_scene[0].T_camera_cloud if (T := moved_in_world(T_world_cloud, read)) is None else T

    return PlacedBoxes(path, PackedTruths((name, each.objects) for name, each in frames.items()), pose)


def _by_camera(cameras: tuple[SceneCamera, ...], frame: Frame) -> RigidTransform | None:
    K = frame.camera.matrix
    off = [float(np.abs(camera.K - K).max() / K[0, 0]) for camera in cameras]
    best = int(np.argmin(off)) if off else None
    return frame.T_camera_label if best is None or off[best] > SAME_CAMERA else cameras[best].T_camera_cloud


@dataclass(frozen=True)
class _SampleBoxes(PlacedBoxes):
    """Boxes around a vehicle, of which each camera's frame gets those that its image shows.

    `objects` are by their sample, in the frame of the recordings' own labels.

    Attributes:
        places: the sample of each of a project's frames, by "RECORDING/KEY"; see `in_project`.
    """

    places: Mapping[str, str] = field(default_factory=dict)
    # the places of the boxes that are in an image, by sample
    _seen: defaultdict[str, set[int]] = field(default_factory=lambda: defaultdict(set), init=False)

    @property
    def frames(self) -> Sequence[str]:
        found = set(self.places.values())
        return (*self.places, *(sample for sample in self.objects if sample not in found))

    def _placed(self, places: Mapping[str, str | None], what: str, of: str) -> LabelSet:
        """Returns the boxes by the project's frames, by "RECORDING/KEY" with their sample."""
        found = {name: sample for name, sample in places.items() if sample is not None and sample in self.objects}
        if not found:
            problem = f"the project has none of its {what} ({len(self.objects)}); add {of} to the project first"
            raise FormatError(self.path, problem)
        return replace(self, places=found)

    def unseen(self) -> int:
        return sum(len(self.objects[sample]) - len(seen) for sample, seen in self._seen.items())

    def _objects(self, name: str) -> Sequence[Truth]:
        return self.objects[self.places.get(name, name)]

    def _in_camera(self, name: str, truths: Sequence[Truth], read: Callable[[], Frame]) -> list[Truth]:
        frame = read()
        K, size = frame.camera.matrix, (frame.camera.width_px, frame.camera.height_px)
        moved = transformed(truths, frame.T_camera_label)
        seen = [place for place, truth in enumerate(moved) if is_seen(truth.box, K, *size)]
        self._seen[self.places.get(name, name)].update(seen)
        return [moved[place] for place in seen]


class NuScenesResults(_SampleBoxes):
    """The boxes of a detector or tracker, in the global frame, by the token of their sample."""

    def in_project(self, project: Project) -> LabelSet:
        """Returns the boxes by the project's frames: those of each camera of the samples' recordings."""
        source, places = FrameSource(project), dict[str, str | None]()
        for stored in project.recordings.all():
            if stored.format in (NuScenes.format, LookAround.format):
                recording = source.recording(stored.id)
                base = recording.base if isinstance(recording, LookAround) else recording
                if isinstance(base, NuScenes):
                    places |= {f"{stored.name}/{key}": base.sample(key) for key in base.keys}
        return self._placed(places, "samples", "their scenes")


def nuscenes_labels(path: Path, on_fault: OnFault = raise_fault) -> PlacedBoxes:
    """Reads a file of results, or a folder of tables."""
    return (
        NuScenesResults(path, PackedTruths(read_results(path))) if path.is_file() else nuscenes_tables(path, on_fault)
    )


class ArgoverseLabels(_SampleBoxes):
    """The annotations of an Argoverse 2 log, in the ego frame, by the time of their sweep."""

    def in_project(self, project: Project) -> LabelSet:
        """Returns the boxes by the project's frames: those of each camera of the log."""
        formats = (ArgoverseLog.format, LookAround.format)
        names = {stored.id: stored.name for stored in project.recordings.all() if stored.format in formats}
        frames = project.frames.of(tuple(names))
        return self._placed(
            {f"{names[each.recording_id]}/{each.key}": each.key for each in frames}, "sweeps", "their log"
        )


def argoverse_labels(path: Path) -> ArgoverseLabels:
    """Reads `annotations.feather`, or that of a log."""
    file = path / ANNOTATIONS if path.is_dir() else path
    return ArgoverseLabels(path, PackedTruths((str(time_ns), boxes) for time_ns, boxes in read_argoverse(file).items()))


def rcv_labels(path: Path) -> PlacedBoxes:
    """Reads an `rcv` dataset."""
    dataset = read_rcv(path)
    frames = [dataset.named_labels(i) for i in range(len(dataset))]
    poses = {name: pose for name, *_, pose in frames}
    return PlacedBoxes(
        path,
        PackedTruths((name, [truth_of(each) for each in labels]) for name, labels, *_ in frames),
        lambda name, read: moved_in_world(poses[name], read),
        states={name: tuple(each.state for each in labels) for name, labels, *_ in frames},
        values={name: values for name, _, values, _ in frames},
    )


def truth_of(label: Label) -> Truth:
    """Returns a label as the object that it is."""
    return Truth(
        label.label,
        label.box,
        label.track_id,
        label.score,
        box_kind=label.box_kind,
        attributes=label.attributes,
        said=label.said,
    )


def openlabel_labels(path: Path, angles: AngleUnit | None = None) -> PlacedBoxes:
    """Reads OpenLABEL documents."""
    frames = read_openlabel(path, angles)

    def pose(name: str, read: Callable[[], Frame]) -> RigidTransform | None:
        own = frames[name]
        return moved_in_world(own.T_world_sensor, read) if own.of_camera else read().T_camera_label

    return PlacedBoxes(
        path,
        PackedTruths((name, each.boxes) for name, each in frames.items()),
        pose,
        states={name: tuple(box.state for box in each.boxes) for name, each in frames.items()},
        values={name: each.attributes for name, each in frames.items()},
    )


Reader = Callable[[Path, AngleUnit | None, OnFault], PlacedBoxes]
"""Reads all labels at a path. The second argument is the unit of angles (None: as the format says), the third takes
faults of single boxes, which are skipped then; most readers raise at the first one."""

READERS: dict[BoxFormat, Reader] = {
    BoxFormat.RCV: lambda path, angles, on_fault: rcv_labels(path),
    BoxFormat.KITTI: lambda path, angles, on_fault: kitti_labels(path, angles),
    BoxFormat.KITTI_TRACKING: lambda path, angles, on_fault: kitti_tracking_labels(path, angles),
    BoxFormat.SUNRGBD: lambda path, angles, on_fault: sunrgbd_labels(path),
    BoxFormat.OPENLABEL: lambda path, angles, on_fault: openlabel_labels(path, angles),
    BoxFormat.LABELCLOUD: labelcloud_labels,
    BoxFormat.NUSCENES: lambda path, angles, on_fault: nuscenes_labels(path, on_fault),
    BoxFormat.SUSTECHPOINTS: lambda path, angles, on_fault: sustechpoints_labels(path, angles),
    BoxFormat.BOXES: lambda path, angles, on_fault: boxes_labels(path),
    BoxFormat.ARGOVERSE2: lambda path, angles, on_fault: argoverse_labels(path),
    BoxFormat.BOX_CSV: lambda path, angles, on_fault: box_csv_labels(path, angles),
}


def read_labels(format: BoxFormat, path: Path, angles: AngleUnit | None = None) -> LabelSet:
    """Reads and checks all labels at `path`.

    Args:
        angles: unit of the angles, if it is not what the format says, or if the labels do not show it.
    """
    if angles is not None and not FORMATS[format].angles:
        with_angles = ", ".join(name for name, each in FORMATS.items() if each.angles)
        raise ConfigError(f"{format} has no angles; leave out --angles (it is for {with_angles})")
    dataset = READERS[format](path, angles, raise_fault)
    Lengths(dataset.sizes_m).require(path)
    return dataset
