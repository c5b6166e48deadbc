"""The formats whose boxes belong to one frame each, and have no review state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from annotator.formats.box_csv import read_upright_boxes
from annotator.formats.boxes_json import boxes_file, each_frame
from annotator.formats.kitti_objects import KittiRows, each_kitti_frame, read_kitti_shifts
from annotator.formats.kitti_rows import label_frame
from annotator.formats.kitti_tracking import read_kitti_tracks
from annotator.formats.labelcloud import LabelCloudFrame, read_labelcloud
from annotator.formats.nuscenes import read_nuscenes, read_world_poses
from annotator.formats.packed_truths import PackedTruths
from annotator.formats.sunrgbd import read_extracted_folder
from annotator.formats.sunrgbd_table import read_meta, upright_frame
from annotator.formats.sustechpoints import SceneCamera, read_sustechpoints
from annotator.formats.units import Angles, AngleUnit
from annotator.recordings.sunrgbd import read_extracted_calibration
from annotator.types import Frame, Truth
from annotator.workflows.importing.readers.placed_boxes import PlacedBoxes, Pose, moved_in_world

# Two cameras with matrices that differ less, as a share of the focal length, are the same.
SAME_CAMERA = 0.01


def boxes_labels(path: Path) -> PlacedBoxes:
    """Reads a `boxes.json` file, or that of a folder. Raises FormatError: missing, or not valid."""
    return PlacedBoxes(path, PackedTruths(each_frame(boxes_file(path))))


def kitti_labels(path: Path, angles: AngleUnit | None = None) -> PlacedBoxes:
    """Reads a folder of KITTI object labels. Raises FormatError as `each_kitti_frame` and `read_kitti_shifts`."""
    found = KittiRows(Angles(angles))
    objects = PackedTruths(each_kitti_frame(path, found))
    return PlacedBoxes(path, objects, _from_rectified(read_kitti_shifts(path)), found.flat)


def kitti_tracking_labels(path: Path, angles: AngleUnit | None = None) -> PlacedBoxes:
    """Reads KITTI tracking labels of whole sequences. Raises FormatError as `read_kitti_tracks`."""
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
    """Reads SUN RGB-D labels: a folder in VoteNet's layout (upright boxes), or the data set's table (tilted boxes).

    Raises FormatError for invalid labels, FrameError for invalid calibrations.
    """
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
    """Reads a CSV file of boxes in upright depth. Raises FormatError as `read_upright_boxes`."""
    return PlacedBoxes(path, PackedTruths(read_upright_boxes(path, angles).items()), _from_upright({}))


def _from_upright(poses: Mapping[str, RigidTransform]) -> Pose:
    """From upright depth.

    Args:
        poses: T_camera_upright of frames with a calibration in the dataset; for others it follows from the frame.
    """

    def pose(name: str, read: Callable[[], Frame]) -> RigidTransform:
        return poses[name] if name in poses else upright_frame(read())

    return pose


def labelcloud_labels(path: Path, angles: AngleUnit | None = None) -> PlacedBoxes:
    """Reads a labelCloud project.

    Raises FormatError: not a labelCloud project, or a label file that does not follow the format.
    """
    return of_labelcloud(path, read_labelcloud(path, angles=angles))


def of_labelcloud(path: Path, frames: Mapping[str, LabelCloudFrame]) -> PlacedBoxes:
    """Boxes in the frames of their clouds; transformed to the camera by the dataset's calibration, else the frame's."""
    poses = {name: each.T_camera_cloud for name, each in frames.items()}

    def pose(name: str, read: Callable[[], Frame]) -> RigidTransform | None:
        return read().T_camera_label if (T := poses[name]) is None else T

    objects = ((name, [Truth(label, box) for label, box in each.boxes]) for name, each in frames.items())
    return PlacedBoxes(path, PackedTruths(objects), pose)


def nuscenes_tables(path: Path) -> PlacedBoxes:
    """Reads the annotations of every camera's images in a folder of nuScenes tables.

    Raises FormatError: no such folder, or rows that do not follow the schema.
    """
    objects = (
        (name, [Truth(each.label, each.box, each.track_id, attributes=each.attributes) for each in boxes])
        for name, boxes in read_nuscenes(path).items()
    )
    poses = read_world_poses(path)
    return PlacedBoxes(path, PackedTruths(objects), lambda name, read: moved_in_world(poses.get(name), read))


def sustechpoints_labels(path: Path, angles: AngleUnit | None = None) -> PlacedBoxes:
    """Reads SUSTechPOINTS' labels, which are in the frames of their clouds.

    They are transformed to the camera by the scene's calibration of the camera that the frame has. Without one, they
    are in the frame of the recording's own labels: for a folder of clouds, that of the clouds.

    Raises FormatError: as `read_sustechpoints`.
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
