"""SUSTechPOINTS: scenes of clouds, each frame with a JSON file of fully oriented boxes.

    [PART/]SCENE/lidar/ID.pcd                 clouds, z up, with colours and reflectances if known
    [PART/]SCENE/camera/front/ID.png          images (or .jpg), and calib/camera/front.json, one for the scene
    [PART/]SCENE/label/ID.json                the boxes: a list of {"obj_id", "obj_type", "psr", "obj_attr"}, or an
                                              object with this list as `objs`
    [PART/]SCENE/ego_pose/ID.json             where the frame is in the recording's map coordinates, if it has such
    frames.csv                                the origin of each frame

In `psr`, `position` is the centre, `scale` the full length, width and height, and `rotation` the angles in radians with
R = Rx Ry Rz (`euler_angle_to_rotate_matrix` in its `util.js`), all in the cloud's frame. `obj_attr` is a text, to which
its page adds the attributes that it offers, separated by commas; values are written as `pose.sitting`. A calibration
holds `extrinsic`, the 4 x 4 transform from the cloud to the camera, and `intrinsic`, the 3 x 3 matrix, both row by row.

An ego pose holds `x`, `y`, `z` in metres and `azimuth` (clockwise from y), `pitch` and `roll` in degrees; the page puts
the cloud at `EGO_CLOUD` in the ego frame (`calcTransformMatrix` in its `world.js`).

A scene has one calibration. So its clouds are in the level frame of its first frame (x ahead, y left, z against
gravity), and a recording whose camera changes becomes several scenes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float64
from pydantic import ConfigDict, Field, RootModel, model_validator
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats import reading
from annotator.formats.dataset_writing import DatasetItem, DatasetWriter, FileNames
from annotator.formats.frame_names import DatasetNames, LabelledFrame, Pose, add_once, from_joined, in_world, joined
from annotator.geometry.projection import straightened
from annotator.geometry.transforms import level_pose
from annotator.text import normal, spelled
from annotator.types import Frame, Label, OrientedBox, PointCloud, Truth
from annotator.types.bases import FileRecord
from annotator.types.errors import FormatError
from annotator.types.label import MOST_TRACK

CLOUDS, LABELS, IMAGES, CALIBRATIONS = "lidar", "label", "camera/front", "calib/camera"
CAMERA, POSES = "front.json", "ego_pose"
# The ego frame has x right and y ahead; its origin is below the LiDAR, which looks back.
EGO_CLOUD = RigidTransform.from_components([0.0, 0.0, 0.4], Rotation.from_euler("z", np.pi))


class _Scale(FileRecord):
    x: reading.BoundedPositive
    y: reading.BoundedPositive
    z: reading.BoundedPositive


class _Psr(FileRecord):
    position: reading.Axes
    scale: _Scale
    rotation: reading.Axes


class _Object(FileRecord):
    obj_id: str | int | None = None
    obj_type: Annotated[str, Field(min_length=1)]
    obj_attr: str | None = None
    psr: _Psr


class _Labels(RootModel[tuple[_Object, ...]]):
    model_config = ConfigDict(frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _list(cls, content: object) -> object:
        return content["objs"] if isinstance(content, dict) and "objs" in content else content


class _EgoPose(reading.Axes):
    azimuth: reading.Bounded
    pitch: reading.Bounded
    roll: reading.Bounded


class _Calibration(FileRecord):
    extrinsic: Annotated[tuple[reading.Bounded, ...], Field(min_length=16, max_length=16)]
    intrinsic: Annotated[tuple[reading.Bounded, ...], Field(min_length=9, max_length=9)]


class SceneCamera(NamedTuple):
    """One calibrated camera of a scene: its 3 x 3 matrix, and the transform from the clouds to it."""

    K: Float64[np.ndarray, "3 3"]
    T_camera_cloud: RigidTransform


# Two cameras with matrices that differ less, as a share of the focal length, are the same.
SAME_CAMERA = 0.01


def read_sustechpoints(path: Path, angles: reading.AngleUnit | None = None) -> dict[str, LabelledFrame]:
    """Returns the labels of a data folder, one scene, or a folder `label`, by frame name.

    Names are "RECORDING/KEY" if the dataset has a frames.csv, else the stem of the label file. Ids that are no whole
    numbers become track ids that the labels do not use.

    Args:
        angles: their unit; None: radians, as the format says.
    """
    files: dict[Path, tuple[_Object, ...]] = {}
    poses: dict[Path, tuple[str, Pose]] = {}
    for folder in _label_folders(path):
        names = DatasetNames.of(folder.parent)
        cameras = tuple(_camera(file) for file in sorted((folder.parent / CALIBRATIONS).glob("*.json")))
        for file in sorted(folder.glob("*.json")):
            # the only camera of an export of annotator is that of the frame
            is_export = normal(file.stem) in names.frames and len(cameras) == 1
            pose: Pose = (
                partial(_of_export, cameras[0], in_world(_place(file))) if is_export else partial(_by_camera, cameras)
            )
            files[file], poses[file] = reading.read_model(file, _Labels).root, (names.known(file.stem), pose)
    tracks, read, frames = _tracks(files), reading.Angles(angles), dict[str, LabelledFrame]()
    for file, objects in files.items():
        truths = [_truth(each, file, tracks.get((file.parent, _id(each))), read) for each in objects]
        name, pose = poses[file]
        add_once(frames, file, name, LabelledFrame(truths, pose))
    read.require()
    return frames


def _by_camera(cameras: Sequence[SceneCamera], frame: Frame) -> RigidTransform | None:
    """By the scene's calibration of the camera that the frame has. Without one, boxes are in the frame of the
    recording's own labels: for a folder of clouds, that of the clouds.
    """
    K = frame.camera.matrix
    off = [float(np.abs(camera.K - K).max() / K[0, 0]) for camera in cameras]
    best = int(np.argmin(off)) if off else None
    return frame.T_camera_label if best is None or off[best] > SAME_CAMERA else cameras[best].T_camera_cloud


def _of_export(camera: SceneCamera, in_map: Pose | None, frame: Frame) -> RigidTransform | None:
    """By the place of the cloud in map coordinates, where that is known; else by the calibration."""
    T = None if in_map is None else in_map(frame)
    return camera.T_camera_cloud if T is None else T


def _label_folders(path: Path) -> Iterator[Path]:
    places = (path / LABELS, *sorted(path.glob(f"*/{LABELS}")), *sorted(path.glob(f"*/*/{LABELS}")), path)
    found = [place for place in places if place.is_dir() and next(place.glob("*.json"), None) is not None]
    if path.is_file():
        raise FormatError(path, f"has the labels of one frame; give the folder of all: {path.parent}")
    if not found:
        raise FormatError(path, f"has no label file of SUSTechPOINTS (SCENE/{LABELS}/*.json)")
    # a folder with scenes has no label files of its own
    yield from found[:-1] if len(found) > 1 and found[-1] == path else found


def _truth(entry: _Object, file: Path, track_id: int | None, read: reading.Angles) -> Truth:
    psr = entry.psr
    angles = [read.radians(each, file) for each in (psr.rotation.x, psr.rotation.y, psr.rotation.z)]
    center = np.array([psr.position.x, psr.position.y, psr.position.z])
    with reading.faults(file, f"{entry.obj_type}: "):
        box = OrientedBox.at(
            RigidTransform.from_components(center, Rotation.from_euler("XYZ", angles)),
            np.array([psr.scale.x, psr.scale.y, psr.scale.z]),
        )
    return Truth(entry.obj_type, box, track_id, attributes=from_joined(entry.obj_attr or ""))


def _id(entry: _Object) -> str:
    return "" if entry.obj_id is None else str(entry.obj_id).strip()


def _tracks(files: Mapping[Path, Sequence[_Object]]) -> dict[tuple[Path, str], int]:
    """Returns the track ids of objects by their folder and id, which is any text: whole numbers stay, others get
    unused numbers in a scene.
    """
    ids = {(file.parent, text): None for file, objects in files.items() for text in map(_id, objects) if text}
    numbers = {text: int(text) for _, text in ids if text.isascii() and text.isdigit() and len(text) < 20}
    kept = {text: number for text, number in numbers.items() if number <= MOST_TRACK}
    used = set(kept.values())
    unused = (number for number in count(1) if number not in used)
    return {place: kept[place[1]] if place[1] in kept else next(unused) for place in ids}


def _camera(file: Path) -> SceneCamera:
    content = reading.read_model(file, _Calibration)
    pose, K = np.array(content.extrinsic).reshape(4, 4), np.array(content.intrinsic).reshape(3, 3)
    R = pose[:3, :3]
    if (problem := reading.rotation_problem(R)) is not None:
        raise FormatError(file, f"extrinsic {problem}")
    return SceneCamera(K, RigidTransform.from_components(pose[:3, 3], Rotation.from_matrix(R)))


def _place(label_file: Path) -> RigidTransform | None:
    """Returns the pose of a cloud in the world; None without a file of it."""
    file = spelled(label_file.parent.parent / POSES, label_file.name)
    if not file.is_file():
        return None
    pose = reading.read_model(file, _EgoPose)
    turn = Rotation.from_euler("ZXY", [-pose.azimuth, pose.pitch, pose.roll], degrees=True)
    return RigidTransform.from_components([pose.x, pose.y, pose.z], turn) * EGO_CLOUD


class SustechWriter(DatasetWriter):
    def begin(self) -> None:
        self._scenes = FileNames()
        self._begun: dict[tuple[str | None, str, bytes], tuple[str, RigidTransform]] = {}

    def frame(self, item: DatasetItem, frame_id: str) -> None:
        """Writes the files of a frame, and the calibration of a new scene."""
        camera, rgb = straightened(item.frame.camera, item.frame.rgb)
        key = (item.split, item.recording, camera.matrix.tobytes())
        is_new = key not in self._begun
        if is_new:
            self._begun[key] = (self._scenes.add(item.recording), level_pose(item.frame.up))
        name, T_scene_camera = self._begun[key]
        scene = f"{item.split or '.'}/{name}"
        if is_new:
            calibration = {
                "extrinsic": T_scene_camera.inv().as_matrix().ravel().tolist(),
                "intrinsic": camera.matrix.ravel().tolist(),
            }
            self.put(f"{scene}/{CALIBRATIONS}/{CAMERA}", json.dumps(calibration) + "\n")
        self.put_image(f"{scene}/{IMAGES}/{frame_id}", rgb)
        self.put(f"{scene}/{CLOUDS}/{frame_id}.pcd", _pcd(item.frame.cloud, T_scene_camera))
        if item.frame.T_world_camera is not None:
            pose = json.dumps(_ego_pose(item.frame.T_world_camera * T_scene_camera.inv()))
            self.put(f"{scene}/{POSES}/{frame_id}.json", pose + "\n")
        boxes = [_entry(label, label.box.transformed(T_scene_camera)) for label in item.labels]
        self.put(f"{scene}/{LABELS}/{frame_id}.json", json.dumps(boxes, indent=1) + "\n")
        self.counts.update(label.label for label in item.labels)


def _ego_pose(T_world_cloud: RigidTransform) -> dict[str, float]:
    T = T_world_cloud * EGO_CLOUD.inv()
    turn, pitch, roll = T.rotation.as_euler("ZXY", degrees=True).tolist()
    return _axes(T.translation) | {"azimuth": -turn, "pitch": pitch, "roll": roll}


def _entry(label: Label, box: OrientedBox) -> dict[str, object]:
    psr = {
        "position": _axes(box.center_m),
        "scale": _axes(box.size_m),
        "rotation": _axes(reading.angles_xyz(box.rotation)),
    }
    entry: dict[str, object] = {
        "obj_id": "" if label.track_id is None else str(label.track_id),
        "obj_type": label.label,
        "psr": psr,
    }
    return entry | ({"obj_attr": joined(label.attributes)} if label.attributes else {})


def _axes(values: Float64[np.ndarray, "3"]) -> dict[str, float]:
    return dict(zip("xyz", (values + 0.0).tolist(), strict=True))


def _pcd(cloud: PointCloud, T_scene_camera: RigidTransform) -> bytes:
    """A binary PCD file (version 0.7), with packed colours and `intensity` if known."""
    fields = [(axis, "<f4") for axis in "xyz"]
    fields += [("rgb", "<f4")] if cloud.rgb is not None else []
    fields += [("intensity", "<f4")] if cloud.reflectance is not None else []
    rows = np.empty(len(cloud), np.dtype(fields))
    for axis, values in zip("xyz", T_scene_camera.apply(cloud.xyz_m).T, strict=True):
        rows[axis] = values
    if cloud.rgb is not None:
        red, green, blue = cloud.rgb.astype("<u4").T
        rows["rgb"] = (red << 16 | green << 8 | blue).view("<f4")
    if cloud.reflectance is not None:
        rows["intensity"] = cloud.reflectance
    names, each = " ".join(name for name, _ in fields), len(fields)
    head = (
        f"VERSION 0.7\nFIELDS {names}\nSIZE{' 4' * each}\nTYPE{' F' * each}\nCOUNT{' 1' * each}\nWIDTH {len(rows)}\n"
        f"HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    return head.encode() + rows.tobytes()
