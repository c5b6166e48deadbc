"""The sensors' data of one scene of nuScenes, from its tables."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import TypeVar

from scipy.spatial.transform import RigidTransform

from annotator.file_names import posix_path
from annotator.geometry.transforms import Quaternions
from annotator.nuscenes_tables import (
    CalibratedSensor,
    EgoPose,
    Record,
    Sample,
    SampleData,
    Scene,
    Sensor,
    TableError,
    find_rows,
    pose,
    read_rows,
)
from annotator.types.errors import RecordingError

LIDAR = "LIDAR_TOP"
REMEDY = "correct the table, or copy it again from the data set"

Row = TypeVar("Row", bound=Record)


@dataclass(frozen=True, eq=False)
class Shot:
    """One image or scan.

    Attributes:
        sample: token of the annotated moment that it belongs to; None between those moments (a sweep).
        file: relative to the dataset's root.
        ego, mount: the vehicle's pose at that time, and the sensor's on the vehicle.
        width_px, height_px: size of the image; 0 for a scan.
    """

    sample: str | None
    file: str
    time_us: int
    ego: EgoPose
    mount: CalibratedSensor
    width_px: int
    height_px: int

    def T_global_sensor(self) -> RigidTransform:
        """Returns the sensor's pose when it was taken.

        Raises:
            TableError: a rotation is not a unit quaternion.
        """
        return pose(self.ego.translation, self.ego.rotation) * pose(self.mount.translation, self.mount.rotation)


@dataclass(frozen=True, eq=False)
class SceneData:
    """The images of each camera and the scans of the LiDAR of a scene, in time order.

    Attributes:
        missing: folders that are not there; their files are left out.
    """

    cameras: dict[str, tuple[Shot, ...]]
    scans: tuple[Shot, ...]
    missing: tuple[str, ...]


def table_folders(path: Path) -> list[Path]:
    """Returns the folders of tables of the dataset at `path`: the folder itself, or its `v1.0-*`."""
    if _has_tables(path):
        return [path]
    return sorted(filter(_has_tables, path.glob("v1.0-*"))) if path.is_dir() else []


def scene_names(tables: Path) -> dict[str, str]:
    """Returns the token of each scene by its name, in the order of the table.

    Raises:
        RecordingError: the table is missing or damaged, has no scene, or two scenes with one name.
    """
    names: dict[str, str] = {}
    for row in _rows(tables, Scene):
        if row.name in names:
            raise RecordingError(f"{tables / 'scene.json'}: two scenes are called {row.name}; {REMEDY}")
        names[row.name] = row.token
    if not names:
        raise RecordingError(f"{tables / 'scene.json'}: has no scene; {REMEDY}")
    return names


def read_scene(tables: Path, token: str) -> SceneData:
    """Reads a scene; the last few scenes are cached, because each of its cameras is a recording.

    Raises:
        RecordingError: a table is missing or damaged, refers to rows that do not exist, or has quaternions of the
            vehicle with w last.
    """
    names = ("sample", "sample_data", "calibrated_sensor", "sensor", "ego_pose")
    try:
        status = [(tables / f"{name}.json").stat() for name in names]
    except OSError as error:
        raise RecordingError(f"{error.filename}: cannot be read: {error.strerror}; {REMEDY}") from error
    shots = _read_scene(tables, token, tuple((each.st_mtime_ns, each.st_size) for each in status))
    # sweeps are a separate download, so whole folders may be missing
    folders = {_folder(shot) for each in shots.values() for shot in each}
    missing = {folder for folder in folders if not (tables.parent / folder).is_dir()}
    present = {sensor: tuple(shot for shot in each if _folder(shot) not in missing) for sensor, each in shots.items()}
    cameras = {channel: each for (modality, channel), each in present.items() if modality == "camera" and each}
    lidars = {channel: each for (modality, channel), each in present.items() if modality == "lidar" and each}
    if len(lidars) > 1 and LIDAR not in lidars:
        raise RecordingError(f"{tables}: has several LiDARs ({', '.join(lidars)}), but none is called {LIDAR}")
    return SceneData(cameras, lidars.get(LIDAR, next(iter(lidars.values()), ())), tuple(sorted(missing)))


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
    """
    Raises:
        RecordingError: the vehicle stands upright only if w is the last number of its quaternions.
    """
    quaternions = Quaternions(thing="pose of the vehicle is", things="poses of the vehicle are")
    for row in poses.values():
        quaternions.add(row.rotation)
    if (problem := quaternions.problem()) is not None:
        raise RecordingError(f"{tables / 'ego_pose.json'}: {problem}, also in calibrated_sensor.json")


def _inside(tables: Path, token: str, name: str) -> str:
    """Refuses the name of a file outside the dataset, which may be a device that never ends.

    Raises:
        RecordingError: it is one.
    """
    path = PurePosixPath(posix_path(name))
    if path.is_absolute() or ".." in path.parts or "\0" in name:
        raise RecordingError(
            f"{tables / 'sample_data.json'}: row {token}: filename: {name!r} must be a path in the dataset; {REMEDY}"
        )
    return str(path)


def _folder(shot: Shot) -> str:
    return shot.file.rpartition("/")[0]


def _has_tables(folder: Path) -> bool:
    return (folder / "sample_data.json").is_file() and (folder / "scene.json").is_file()


def _rows(tables: Path, model: type[Row], field: str = "", wanted: Collection[str] = ()) -> list[Row]:
    """Returns the rows of a table; with `field`, those with one of the `wanted` values in it."""
    path = tables / f"{_table(model)}.json"
    try:
        return list(find_rows(path, model, field, wanted) if field else read_rows(path, model))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}; {REMEDY}") from error
    except TableError as error:
        raise RecordingError(f"{path}: {error}; {REMEDY}") from error


def _row(tables: Path, table: str, token: str, rows: dict[str, Row], model: type[Row], wanted: str) -> Row:
    if wanted not in rows:
        raise RecordingError(
            f"{tables / table}.json: row {token} refers to {wanted}, which is not in {_table(model)}.json; {REMEDY}"
        )
    return rows[wanted]


def _table(model: type[Record]) -> str:
    return {"SampleData": "sample_data", "CalibratedSensor": "calibrated_sensor", "EgoPose": "ego_pose"}.get(
        model.__name__, model.__name__.lower()
    )
