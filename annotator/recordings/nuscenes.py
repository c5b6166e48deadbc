"""nuScenes: one scene, seen by one of its cameras.

v1.0-*/*.json   the tables (scene, sample, sample_data, sensor, calibrated_sensor, ego_pose)
samples/, sweeps/   images and scans, where the tables say; a scan is float32 x y z intensity (0..255) ring
[sample_annotation.json, instance.json, category.json: read by annotator.formats.nuscenes]

A frame is an image with the scan of its sample; between samples, with the scan that was being taken, else the one
before. The vehicle's poses at both times move the scan to the image's time. Labels are in the global frame.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path, PurePosixPath
from typing import ClassVar, TypeVar

import numpy as np
from jaxtyping import UInt8
from scipy.spatial.transform import RigidTransform

from annotator.geometry.transforms import FORWARD, Quaternions
from annotator.nuscenes_tables import (
    CalibratedSensor,
    EgoPose,
    Record,
    Sample,
    SampleData,
    Scene,
    Sensor,
    find_rows,
    pose,
    read_rows,
)
from annotator.recordings.clouds.cloud_folder import VIRTUAL_CAMERA
from annotator.recordings.image_file import read_color_image
from annotator.recordings.kitti import visible_cloud
from annotator.recordings.listing import file_errors
from annotator.recordings.look_around import (
    R_CAMERA_LEVEL,
    RigCamera,
    Scan,
    Scanned,
    Scenes,
    choose,
    level_turn,
    virtual_frame,
)
from annotator.recordings.plausible import is_pinhole, pinhole
from annotator.recordings.recording import ReaderOptions
from annotator.recordings.scan_file import NUSCENES, Scans
from annotator.text import posix_path, spelled
from annotator.types import Camera, Frame
from annotator.types.errors import FrameError, RecordingError
from annotator.types.messages import amount

LIDAR = "LIDAR_TOP"

Row = TypeVar("Row", bound=Record)


@dataclass(frozen=True, eq=False)
class Shot:
    """One image, or a scan (of size 0).

    `sample` is the token of the annotated moment that it belongs to; None between those moments (a sweep). `ego` and
    `mount` are the poses of the vehicle at that time, and of the sensor on it.
    """

    sample: str | None
    file: str
    time_us: int
    ego: EgoPose
    mount: CalibratedSensor
    width_px: int
    height_px: int

    @property
    def folder(self) -> str:
        return self.file.rpartition("/")[0]

    def T_global_sensor(self) -> RigidTransform:
        return pose(self.ego.translation, self.ego.rotation) * pose(self.mount.translation, self.mount.rotation)


Shots = tuple[Shot, ...]


def table_folders(path: Path) -> list[Path]:
    """Returns the folders of tables of the dataset at `path`: the folder itself, or its `v1.0-*`."""
    if _has_tables(path):
        return [path]
    return sorted(filter(_has_tables, path.glob("v1.0-*"))) if path.is_dir() else []


def scene_names(tables: Path) -> dict[str, str]:
    names: dict[str, str] = {}
    for row in _rows(tables, Scene):
        if row.name in names:
            raise RecordingError(f"{tables / 'scene.json'}: two scenes are called {row.name}; {REMEDY}")
        names[row.name] = row.token
    if not names:
        raise RecordingError(f"{tables / 'scene.json'}: has no scene; {REMEDY}")
    return names


def read_scene(tables: Path, token: str) -> tuple[dict[str, Shots], Shots, list[str]]:
    """Returns the images of each camera and the scans of the LiDAR of a scene, in time order; and missing folders.

    Sweeps are a separate download, so whole folders may be missing; their files are left out. The last few scenes are
    cached, because each of its cameras is a recording.
    """
    names = ("sample", "sample_data", "calibrated_sensor", "sensor", "ego_pose")
    try:
        status = [(tables / f"{name}.json").stat() for name in names]
    except OSError as error:
        raise RecordingError(f"{error.filename}: cannot be read: {error.strerror}; {REMEDY}") from error
    shots = _read_scene(tables, token, tuple((each.st_mtime_ns, each.st_size) for each in status))
    folders = {shot.folder for each in shots.values() for shot in each}
    missing = {folder for folder in folders if not (tables.parent / folder).is_dir()}
    present = {sensor: tuple(shot for shot in each if shot.folder not in missing) for sensor, each in shots.items()}
    cameras = {channel: each for (modality, channel), each in present.items() if modality == "camera" and each}
    lidars = {channel: each for (modality, channel), each in present.items() if modality == "lidar" and each}
    if len(lidars) > 1 and LIDAR not in lidars:
        raise RecordingError(f"{tables}: has several LiDARs ({', '.join(lidars)}), but none is called {LIDAR}")
    return cameras, lidars.get(LIDAR, next(iter(lidars.values()), ())), sorted(missing)


@lru_cache(maxsize=8)
def _read_scene(
    tables: Path, token: str, versions: tuple[tuple[int, int], ...]
) -> dict[tuple[str, str], tuple[Shot, ...]]:
    """Returns the images and scans in time order, by modality and channel."""
    sensors = {row.token: row for row in _rows(tables, Sensor)}
    calibrated = {row.token: row for row in _rows(tables, CalibratedSensor)}
    samples = {row.token for row in _rows(tables, Sample, "scene_token", {token})}
    shots: dict[tuple[str, str], list[Shot]] = {}
    data: list[tuple[Sensor, CalibratedSensor, SampleData]] = []
    for row in _rows(tables, SampleData, "sample_token", samples):
        mount = _row(tables, "sample_data", row.token, calibrated, CalibratedSensor, row.calibrated_sensor_token)
        sensor = _row(tables, "calibrated_sensor", mount.token, sensors, Sensor, mount.sensor_token)
        if sensor.modality in ("camera", "lidar"):
            data.append((sensor, mount, row))
    wanted = {row.ego_pose_token for _, _, row in data}
    poses = {row.token: row for row in _rows(tables, EgoPose, "token", wanted)}
    _require_w_first(tables, poses)
    for sensor, mount, row in data:
        ego = _row(tables, "sample_data", row.token, poses, EgoPose, row.ego_pose_token)
        shot = Shot(
            row.sample_token if row.is_key_frame else None,
            _inside(tables, row.token, row.filename),
            row.timestamp,
            ego,
            mount,
            row.width,
            row.height,
        )
        shots.setdefault((sensor.modality, sensor.channel), []).append(shot)
    return {key: tuple(sorted(each, key=lambda shot: shot.time_us)) for key, each in shots.items()}


def _require_w_first(tables: Path, poses: dict[str, EgoPose]) -> None:
    quaternions = Quaternions(thing="pose of the vehicle is", things="poses of the vehicle are")
    for row in poses.values():
        quaternions.add(row.rotation)
    if (problem := quaternions.problem()) is not None:
        raise RecordingError(f"{tables / 'ego_pose.json'}: {problem}, also in calibrated_sensor.json")


def _inside(tables: Path, token: str, name: str) -> str:
    """Refuses the name of a file outside the dataset, which may be a device that never ends."""
    path = PurePosixPath(posix_path(name))
    if path.is_absolute() or ".." in path.parts or "\0" in name:
        raise RecordingError(
            f"{tables / 'sample_data.json'}: row {token}: filename: {name!r} must be a path in the dataset; {REMEDY}"
        )
    return str(path)


def _has_tables(folder: Path) -> bool:
    return (folder / "sample_data.json").is_file() and (folder / "scene.json").is_file()


def _rows(tables: Path, model: type[Row], field: str = "", wanted: Collection[str] = ()) -> list[Row]:
    path = tables / f"{_table(model)}.json"
    with file_errors(path, REMEDY, kind=RecordingError):
        return list(find_rows(path, model, field, wanted) if field else read_rows(path, model))


def _row(tables: Path, table: str, token: str, rows: dict[str, Row], model: type[Row], wanted: str) -> Row:
    if wanted not in rows:
        raise RecordingError(
            f"{tables / table}.json: row {token} refers to {wanted}, which is not in {_table(model)}.json; {REMEDY}"
        )
    return rows[wanted]


def _table(model: type[Record]) -> str:
    return re.sub(r"(?<!^)([A-Z])", r"_\1", model.__name__).lower()


FRONT = "CAM_FRONT"
# The origins of an export's frames; nuScenes itself has no such file.
EXPORT_MARK = "frames.csv"
SCANS = Scans(NUSCENES)
GLOBAL_UP = np.array([0.0, 0.0, 1.0])
# x of the vehicle's frame
AHEAD = np.array([1.0, 0.0, 0.0])
# The LiDAR's period.
TOLERANCE_S = 0.05
REMEDY = "copy it again from the data set"


@dataclass(frozen=True, eq=False)
class NuScenes(Scanned, RigCamera, Scenes):
    """A `Recording` of a scene's samples and sweeps from one camera, in time order.

    Attributes:
        camera: the camera's channel; "" for the virtual one of a scene without images.
        moments: image and scan of each frame; without images, twice the scan.
    """

    tables: Path
    scenes: tuple[str, ...]
    scene: str
    camera: str
    cameras: tuple[str, ...]
    moments: tuple[tuple[Shot, Shot], ...]
    notes: tuple[str, ...] = ()
    format: ClassVar[str] = "nuscenes"
    is_sequence: ClassVar[bool] = True

    @property
    def is_export(self) -> bool:
        """True for an export of annotator, whose boxes all belong to its one camera."""
        return (self.tables.parent / EXPORT_MARK).is_file()

    @property
    def root(self) -> Path:
        return self.tables.parent

    @property
    def name(self) -> str:
        return f"{self.scene}@{self.camera}" if self.camera else self.scene

    def sample(self, key: str) -> str | None:
        """Returns the token of a frame's annotated moment; None between samples."""
        return self.moments[self.indices[key]][0].sample

    @cached_property
    def samples(self) -> frozenset[str]:
        return frozenset(image.sample for image, _ in self.moments if image.sample is not None)

    def files(self, i: int) -> tuple[Path, ...]:
        self.key(i)
        image, scan = self.moments[i]
        return tuple(spelled(self.root, shot.file) for shot in ((image, scan) if self.camera else (scan,)))

    def image(self, i: int) -> UInt8[np.ndarray, "h w 3"]:
        if not self.camera:
            return super().image(i)
        file, (shot, _) = self.files(i)[0], self.moments[i]
        return read_color_image(file, (shot.width_px, shot.height_px)).rgb

    def frame(self, i: int) -> Frame:
        """Reads frame `i`; its cloud holds the points inside the image, or all without images."""
        key = self.key(i)
        if not self.camera:
            return virtual_frame(self.scan(i), key, i, VIRTUAL_CAMERA, R_CAMERA_LEVEL)
        image, scan = self.moments[i]
        image_file, scan_file = self.files(i)
        picture = read_color_image(image_file, (image.width_px, image.height_px))
        rgb = picture.rgb
        camera = _camera(image_file, image, rgb.shape[1], rgb.shape[0])
        T_camera_global, T_global_lidar = self._poses(image, scan)
        points = SCANS.read_alone(scan_file)
        xyz_m = (T_camera_global * T_global_lidar).apply(points.xyz_m)
        cloud = visible_cloud(scan_file, camera, xyz_m, points, rgb, "check the poses in the tables")
        up = T_camera_global.rotation.apply(GLOBAL_UP)
        moment = {"timestamp_ns": image.time_us * 1000, "T_world_camera": self.pose(i)}
        return picture.frame(key, i, camera, cloud, up=up, T_camera_label=T_camera_global, **moment)

    def scan(self, i: int) -> Scan:
        """Returns the scan of frame `i`; ahead is where the camera looks; without one, where the vehicle does."""
        self.key(i)
        image, scan = self.moments[i]
        T_camera_global, T_global_lidar = self._poses(image, scan)
        R_lidar_global = T_global_lidar.rotation.inv()
        if self.camera:
            ahead = R_lidar_global.apply(T_camera_global.rotation.inv().apply(FORWARD))
        else:
            ahead = pose(scan.mount.translation, scan.mount.rotation).rotation.inv().apply(AHEAD)
        return Scan(
            lambda: SCANS.read_alone(self.files(i)[-1]),
            level_turn(R_lidar_global.apply(GLOBAL_UP), ahead),
            np.zeros(3),
            T_global_lidar.inv(),
            timestamp_ns=scan.time_us * 1000,
            T_world_scan=T_global_lidar if self._knows_world else None,
        )

    @property
    def pose_source(self) -> str | None:
        return "ego_pose.json" if self._knows_world else None

    @cached_property
    def _knows_world(self) -> bool:
        """False for an export whose recording has no map coordinates: its ego frame is nowhere."""
        return any(any(shot.ego.translation) for moment in self.moments for shot in moment)

    def pose(self, i: int) -> RigidTransform | None:
        self.key(i)
        image, scan = self.moments[i]
        if not self.camera:
            return self.scan(i).T_world_camera(R_CAMERA_LEVEL)
        return self._poses(image, scan)[0].inv() if self._knows_world else None

    def moment(self, i: int) -> str:
        self.key(i)
        return PurePosixPath(self.moments[i][1].file).name

    def T_rig_camera(self, i: int) -> RigidTransform:
        """Returns the camera's pose in the frame of the LiDAR at the scan's time."""
        self.key(i)
        T_camera_global, T_global_lidar = self._poses(*self.moments[i])
        return (T_camera_global * T_global_lidar).inv()

    def _poses(self, image: Shot, scan: Shot) -> tuple[RigidTransform, RigidTransform]:
        with file_errors(self.tables, REMEDY, f"the pose of {image.file} or {scan.file}: "):
            return image.T_global_sensor().inv(), scan.T_global_sensor()


def open_nuscenes(path: Path, options: ReaderOptions) -> NuScenes | None:
    """Opens a scene of the dataset at `path`; None if there are no tables.

    Without the option `scene`, it is the first one; without `camera`, CAM_FRONT or the first one. If there are no
    images, the frames are the scans.
    """
    folders = table_folders(path)
    if not folders:
        return None
    if len(folders) > 1:
        names = ", ".join(folder.name for folder in folders)
        raise RecordingError(f"{path}: has several folders of tables ({names}); give the path of one")
    tables, scenes = folders[0], scene_names(folders[0])
    scene, of_scenes = choose(path, "scene", options.scene, scenes, next(iter(scenes)))
    images, scans, missing = read_scene(tables, scenes[scene])
    if not scans:
        why = f" (missing folders: {', '.join(missing)})" if missing else ""
        raise RecordingError(f"{path}: no frames; {scene} has no scan{why}; copy its samples/ beside the tables")
    cameras, within_s = tuple(sorted(images)), options.tolerance_s or TOLERANCE_S
    usual = FRONT if FRONT in images else next(iter(images), "")
    camera, of_cameras = choose(path / scene, "camera", options.camera, cameras, usual)
    moments = _pairs(images[camera], scans, within_s) if camera else tuple((scan, scan) for scan in scans)
    keys = tuple(PurePosixPath(image.file).stem.removesuffix(".pcd") for image, _ in moments)
    if not keys:
        raise RecordingError(f"{path}: no frames; no image of {camera} has a scan within its time; set --tolerance")
    if len(set(keys)) < len(keys):
        raise RecordingError(f"{tables / 'sample_data.json'}: two images of {camera} have one file name; {REMEDY}")
    notes = [*of_scenes, *of_cameras]
    if missing:
        notes.append(f"left out, because these folders are missing: {', '.join(missing)}")
    if not camera:
        notes.append("has no images; a virtual camera looks ahead")
    elif alone := len(images[camera]) - len(moments):
        without = f"{amount(alone, 'image')} without a scan within {within_s:g} s"
        notes.append(f"left out: {without} (--tolerance changes it)")
    return NuScenes(path, keys, tables, tuple(scenes), scene, camera, cameras, moments, tuple(notes))


def _camera(path: Path, image: Shot, width_px: int, height_px: int) -> Camera:
    K = np.array(image.mount.camera_intrinsic)
    if K.shape != (3, 3) or not is_pinhole(K):
        raise FrameError(path, f"its camera_intrinsic (row {image.mount.token}) is not a pinhole camera", REMEDY)
    return pinhole(K, width_px, height_px)


def _pairs(images: Shots, scans: Shots, tolerance_s: float) -> tuple[tuple[Shot, Shot], ...]:
    of_sample = {scan.sample: scan for scan in scans if scan.sample is not None}
    times_us = np.array([scan.time_us for scan in scans])
    pairs = []
    for image in images:
        scan = of_sample.get(image.sample) if image.sample is not None else None
        if scan is None:
            after = int(np.searchsorted(times_us, image.time_us))
            # a scan's time is its end: the next scan was being taken, so all cameras get the same one
            near = [*scans[after : after + 1], *scans[max(after - 1, 0) : after]]
            scan = next((each for each in near if abs(each.time_us - image.time_us) <= tolerance_s * 1e6), None)
        if scan is not None:
            pairs.append((image, scan))
    return tuple(pairs)
