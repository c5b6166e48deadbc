"""nuScenes: tables, one JSON list of records each, linked by tokens; and results of detectors and trackers.

Source: nuScenes schema (`docs/schema_nuscenes.md` of the nuscenes-devkit) and `utils/data_classes.py`: metres, sizes
are width, length, height; a box's x axis points along its length, y along its width, z along its height, as in
annotator; quaternions are w x y z; a scan is float32 x y z intensity ring, the intensity in 0..255. Other fields are
ignored. `annotator.nuscenes_tables` has the tables of the sensors.

Results ("Results format" in the devkit's `eval/detection/README.md` and `eval/tracking/README.md`) are in the global
frame, by the tokens of their samples. Trackers write `tracking_name`, `tracking_score` and `tracking_id`.

    {"meta": {...}, "results": {"SAMPLE": [{"translation": [x, y, z], "size": [width, length, height],
        "rotation": [w, x, y, z], "detection_name": "car", "detection_score": 0.8, "attribute_name": "vehicle.moving"},
        ...], ...}}

A dataset that annotator writes opens with the nuscenes-devkit:

    v1.0-annotator/*.json            the tables; splits.json names the scenes of each part
    samples/CAM_FRONT/ID.png         rectified images (or .jpg)
    samples/LIDAR_TOP/ID.pcd.bin     clouds
    maps/none.png                    the map that the tables require: one black pixel
    frames.csv                       the origin of each frame

Scenes are recordings, instances are tracks. Ego and LiDAR frame are the same: the level frame at the camera (x ahead, y
left, z against gravity). The global frame is the world of the recording's poses or map coordinates; without such, it is
the ego frame, because the camera's motion is unknown.
"""

from __future__ import annotations

import json
import uuid
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import replace
from datetime import UTC, datetime
from itertools import count
from math import isnan
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from jaxtyping import Float32
from pydantic import AliasChoices, Field
from pydantic_core import to_json
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats import reading
from annotator.formats.dataset_writing import DatasetItem, DatasetWriter, FileNames, Lost
from annotator.formats.frame_names import (
    VISIBILITY,
    DatasetNames,
    LabelledFrame,
    add_once,
    dotted,
    from_dotted,
    in_world,
)
from annotator.formats.reading import Lengths
from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.outline import Sight
from annotator.geometry.projection import straightened
from annotator.geometry.transforms import IMAGE_UP, UPRIGHT, Quaternions, level_pose
from annotator.nuscenes_tables import (
    CalibratedSensor,
    EgoPose,
    Record,
    SampleData,
    Sensor,
    Token,
    find_rows,
    pose,
    read_rows,
)
from annotator.text import normal, stem_of
from annotator.types import Camera, Frame, Label, OrientedBox, PointCloud, Truth
from annotator.types.bases import FileRecord, TrackId
from annotator.types.errors import FormatError

Vector3 = reading.Bounded3
Quaternion = reading.Bounded4


class Named(Record):
    """A class, or a property that an annotation may have."""

    name: Token


class Visibility(Record):
    """A level of visibility of an object."""

    level: str


class Instance(Record):
    """An object in all samples of its scene. `track_id` is annotator's extension: the id in the project."""

    category_token: Token
    nbr_annotations: int
    track_id: TrackId | None = None


class SampleAnnotation(Record):
    """A box of a sample, global frame; its x axis is the length, y the width."""

    sample_token: Token
    instance_token: Token
    visibility_token: str = ""
    attribute_tokens: tuple[str, ...] = ()
    translation: Vector3
    size: tuple[reading.BoundedPositive, reading.BoundedPositive, reading.BoundedPositive]
    rotation: Quaternion


MOST_INTENSITY = 255.0


def vector(values: np.ndarray) -> list[float]:
    """Returns numbers for JSON, without negative zeros."""
    numbers: list[float] = (values + 0.0).tolist()
    return numbers


def quaternion(rotation: Rotation) -> list[float]:
    """Returns w x y z, w not negative."""
    return vector(rotation.as_quat(canonical=True, scalar_first=True))


def box_from(translation: Vector3, rotation: Quaternion, size_wlh: Vector3) -> OrientedBox:
    """Returns the box of an annotation, global frame.

    Raises:
        ValueError: the rotation is not a unit quaternion.
    """
    width, length, height = size_wlh
    return OrientedBox.at(pose(translation, rotation), np.array([length, width, height]))


def scan(cloud: PointCloud, T_level_camera: RigidTransform) -> Float32[np.ndarray, "n 5"]:
    """Returns the points in the level frame with intensity (0 if unknown) and ring (0)."""
    intensity = np.zeros(len(cloud)) if cloud.reflectance is None else cloud.reflectance * MOST_INTENSITY
    return np.column_stack([T_level_camera.apply(cloud.xyz_m), intensity, np.zeros(len(cloud))]).astype("<f4")


ANNOTATIONS = "sample_annotation.json"
# A box is in an image if one of its corners is, and all are in front of the camera (devkit: `BoxVisibility.ANY`).
NEAREST_M = 0.1

Row = TypeVar("Row", bound=Record)


def read_nuscenes(path: Path, on_fault: reading.OnFault = reading.raise_fault) -> dict[str, LabelledFrame]:
    """Returns the boxes of each camera's key frames, by frame name.

    With several cameras, each gets the boxes that its image shows. Names are "RECORDING/KEY" if the dataset has a
    frames.csv, else the stem of the image file. Track ids are those of the project that annotator exported; in other
    datasets the instance's row number if it has more than one annotation, else None. Attributes are `vehicle.moving`
    as vehicle = moving, and the visibility's level as `visibility`.

    Args:
        path: the dataset's root, or its folder of tables.
    """
    folder = _table_folder(path)
    names = DatasetNames.of(folder)
    boxes = _boxes(folder, _rows(folder / ANNOTATIONS, SampleAnnotation), on_fault)
    frames: dict[str, LabelledFrame] = {}
    for stem, row, camera, T_global_camera in _camera_images(folder):
        T_camera_global, K, found = T_global_camera.inv(), np.array(camera.camera_intrinsic), list[Truth]()
        for truth in boxes.get(row.sample_token, ()):
            what = f"a box of the sample {row.sample_token}: "
            with reading.reported(on_fault), reading.faults(folder / ANNOTATIONS, what):
                box = truth.box.transformed(T_camera_global)
                # an export has one camera, which has all boxes
                if stem in names.frames or (len(K) and is_seen(box, K, row.width, row.height)):
                    found.append(replace(truth, box=box))
        # without a pose, the camera is the origin
        is_placed = stem in names.frames and T_global_camera.translation.any()
        pose = in_world(T_global_camera) if is_placed else None
        add_once(frames, folder / "sample_data.json", names.known(stem), LabelledFrame(found, pose))
    if not frames:
        raise FormatError(folder / "sample_data.json", "has no key frame of a camera")
    return frames


def _table_folder(path: Path) -> Path:
    folders = [path] if (path / "sample_data.json").is_file() else sorted(path.glob("v1.0-*/"))
    if len(folders) != 1:
        several = f"has several folders of tables ({', '.join(f.name for f in folders)}); give the path of one"
        raise FormatError(path, several if folders else "has no folder of nuScenes tables (v1.0-*)")
    return folders[0]


def _camera_images(folder: Path) -> Iterator[tuple[str, SampleData, CalibratedSensor, RigidTransform]]:
    """Yields the stem of each camera's key frames, its row, its camera, and T_global_camera."""
    sensors, calibrated = _table(folder, "sensor", Sensor), _table(folder, "calibrated_sensor", CalibratedSensor)
    places = _table(folder, "ego_pose", EgoPose)
    file = folder / "sample_data.json"
    for row in _table(folder, "sample_data", SampleData).values():
        # most images are between two key frames, and a pose takes time
        if not row.is_key_frame:
            continue
        camera = _linked(file, row, calibrated, "calibrated_sensor", row.calibrated_sensor_token)
        if _linked(file, row, sensors, "sensor", camera.sensor_token).modality != "camera":
            continue
        place = _linked(file, row, places, "ego_pose", row.ego_pose_token)
        with reading.faults(file, f"row {row.token}: a pose of its camera: "):
            T_global_camera = pose(place.translation, place.rotation) * pose(camera.translation, camera.rotation)
        yield normal(stem_of(row.filename)), row, camera, T_global_camera


def read_sample_boxes(tables: Path, samples: Set[str]) -> dict[str, tuple[Truth, ...]]:
    """Returns the boxes of samples in the global frame, by the sample's token.

    Args:
        tables: the folder of the tables.
    """
    annotations = _rows(tables / ANNOTATIONS, SampleAnnotation, samples)
    Lengths(np.array(row.size) for row in annotations).require(tables / ANNOTATIONS)
    boxes = _boxes(tables, annotations, reading.raise_fault)
    return {sample: tuple(boxes.get(sample, ())) for sample in samples}


def _boxes(tables: Path, annotations: Sequence[SampleAnnotation], on_fault: reading.OnFault) -> dict[str, list[Truth]]:
    """Returns the boxes in the global frame, by the token of their sample; see `read_nuscenes`."""
    instances, categories = _table(tables, "instance", Instance), _table(tables, "category", Named)
    # a track is the row's number
    numbers = {token: number for number, token in enumerate(instances)}
    # other tools leave these tables out
    names = {row.token: row.name for row in _rows(tables / "attribute.json", Named, if_any=True)}
    levels = {row.token: row.level for row in _rows(tables / "visibility.json", Visibility, if_any=True)}
    quaternions, boxes = Quaternions(), dict[str, list[Truth]]()
    for row in annotations:
        instance = _linked(tables / ANNOTATIONS, row, instances, "instance", row.instance_token)
        file, category = tables / "instance.json", instance.category_token
        label = _linked(file, instance, categories, "category", category).name
        values = from_dotted(names[token] for token in row.attribute_tokens if token in names)
        if _is_ours(instance):
            # its levels of visibility are measured, unless they are an attribute as well
            track = instance.track_id
        else:
            # boxes of nuScenes stand upright in the global frame; those of annotator may be tilted
            quaternions.add(row.rotation)
            track = numbers[instance.token] if instance.nbr_annotations > 1 else None
            level = levels.get(row.visibility_token)
            values |= {} if level is None else {VISIBILITY: level}
        with reading.reported(on_fault), reading.faults(tables / ANNOTATIONS, f"row {row.token}: "):
            box = box_from(row.translation, row.rotation, row.size)
            boxes.setdefault(row.sample_token, []).append(Truth(label, box, track, attributes=values))
    quaternions.require(tables / ANNOTATIONS)
    return boxes


def _linked(file: Path, row: Record, rows: Mapping[str, Row], other: str, token: str) -> Row:
    if token not in rows:
        raise FormatError(file, f"row {row.token}: refers to the token {token}, which is not in {other}.json")
    return rows[token]


def _table(folder: Path, name: str, model: type[Row]) -> dict[str, Row]:
    """Returns the rows of a table by their token, in the order of the file."""
    rows: dict[str, Row] = {}
    for row in _rows(folder / f"{name}.json", model):
        if row.token in rows:
            problem = f"row {len(rows)}: the token {row.token} occurs twice; tokens must be unique"
            raise FormatError(folder / f"{name}.json", problem)
        rows[row.token] = row
    return rows


def _is_ours(instance: Instance) -> bool:
    return "track_id" in instance.model_fields_set


def is_seen(box: OrientedBox, K: np.ndarray, width_px: int, height_px: int) -> bool:
    """Returns True if a box (camera frame) is in the image of the camera with the matrix `K` (3, 3)."""
    corners = box_corners(box)
    if (corners[:, 2] < NEAREST_M).any():
        return False
    px = corners @ K.T
    px = px[:, :2] / px[:, 2:]
    return bool(((px > -0.5) & (px < np.array([width_px, height_px]) - 0.5)).all(axis=1).any())


def _rows(path: Path, model: type[Row], samples: Set[str] | None = None, *, if_any: bool = False) -> list[Row]:
    """Returns the rows of a table; with `samples`, those of these samples; with `if_any`, none without the file."""
    if if_any and not path.is_file():
        return []
    with reading.faults(path):
        return list(read_rows(path, model) if samples is None else find_rows(path, model, "sample_token", samples))


RESULTS = "results"


class ResultBox(FileRecord):
    """A box of a detector or tracker."""

    translation: Vector3
    size: tuple[reading.BoundedPositive, reading.BoundedPositive, reading.BoundedPositive]
    rotation: Quaternion
    label: Annotated[str, Field(min_length=1, validation_alias=AliasChoices("detection_name", "tracking_name"))]
    score: Annotated[
        float, Field(allow_inf_nan=False, validation_alias=AliasChoices("detection_score", "tracking_score"))
    ]
    attribute_name: str = ""
    tracking_id: str | int | None = None


def read_results(path: Path) -> Iterator[tuple[str, list[Truth]]]:
    """Yields the objects of each sample, in the global frame; tracks are numbered in the order of the file."""
    tracks: dict[str | int, int] = {}
    quaternions = Quaternions()
    samples = reading.read_object(path).get(RESULTS)
    if not isinstance(samples, dict):
        raise FormatError(path, f"has no object {RESULTS!r}")
    for sample, boxes in samples.items():
        if not isinstance(boxes, list):
            raise FormatError(path, f"results.{sample}: must be a list of boxes")
        yield (
            sample,
            [_truth(path, f"results.{sample}.{n}", each, tracks, quaternions) for n, each in enumerate(boxes)],
        )
    quaternions.require(path)


def _truth(path: Path, where: str, value: object, tracks: dict[str | int, int], quaternions: Quaternions) -> Truth:
    with reading.faults(path, f"{where}: "):
        row = ResultBox.model_validate(value)
        box = box_from(row.translation, row.rotation, row.size)
        quaternions.add(row.rotation)
    track = None if row.tracking_id is None else tracks.setdefault(row.tracking_id, len(tracks))
    attributes = from_dotted([row.attribute_name] if row.attribute_name else [])
    return Truth(row.label, box, track, row.score, attributes=attributes)


VERSION = "v1.0-annotator"
SPLITS = "splits.json"
# The channels that nuScenes' devkit uses.
CAMERA, LIDAR = "CAM_FRONT", "LIDAR_TOP"
MAP_FILE = "maps/none.png"
# nuScenes' levels with their least visible fraction.
SHARES = {"1": (0.0, "v0-40"), "2": (0.4, "v40-60"), "3": (0.6, "v60-80"), "4": (0.8, "v80-100")}
LEVELS = {level: number for number, (_, level) in SHARES.items()}
# Namespace of the tokens: the same project gives the same tables.
NAMESPACE = uuid.UUID("0b9c4a1e-7d55-5f0a-8a57-3a1a5e9be6d2")
# Interval of samples without a time, as in nuScenes.
STEP_US = 500_000

Part = dict[str, Any]
Key = tuple[str, str | None]


def token(*parts: object) -> str:
    """Returns 32 hexadecimal digits, a hash of the parts."""
    return uuid.uuid5(NAMESPACE, "\n".join(map(repr, parts))).hex


# Farther from its camera, a world is a map, whose z is up; that of odometry may be its first image.
MAP_M = 500.0


def _has_z_up(frame: Frame) -> bool:
    """True if z of the frame's world is up, as in nuScenes' global frame; without gravity, if the camera is level."""
    assert frame.T_world_camera is not None
    T, up = frame.T_world_camera, IMAGE_UP if frame.up is None else frame.up
    return bool(np.linalg.norm(T.translation) > MAP_M or T.rotation.apply(up)[2] > UPRIGHT)


class NuScenesWriter(DatasetWriter):
    """Keeps all rows in memory, without images and clouds."""

    def begin(self) -> None:
        import cv2

        # rows that follow each other in time: the samples of a scene, their data of a sensor, boxes of an instance
        self._samples = defaultdict[Key, list[Part]](list)
        self._data = defaultdict[tuple[Key, str], list[Part]](list)
        self._boxes = defaultdict[str, list[Part]](list)
        self._annotations: list[Part] = []
        self._poses: list[Part] = []
        self._calibrations: dict[str, Part] = {}
        self._instances: dict[str, tuple[str, int | None]] = {}
        self._attributes: set[str] = set()
        self._shifts_us: dict[Key, int] = {}
        self._starts_us: set[int] = set()
        self._is_level: dict[Key, bool] = {}
        # of each scene, how many frames have a place in the world, and how many have none
        self._placed: dict[Key, Counter[bool]] = defaultdict(Counter)
        self.put(MAP_FILE, cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes())

    def frame(self, item: DatasetItem, frame_id: str) -> None:
        frame, key = item.frame, (item.recording, item.split)
        T_level_camera, world = level_pose(frame.up), frame.T_world_camera
        if world is not None and not self._is_level.setdefault(key, _has_z_up(frame)):
            self.losses.add(Lost.ORIGIN)
            world = None
        self._placed[key][world is not None] += 1
        camera, rgb = straightened(frame.camera, frame.rgb)
        files = {
            CAMERA: self.put_image(f"samples/{CAMERA}/{frame_id}", rgb),
            LIDAR: f"samples/{LIDAR}/{frame_id}.pcd.bin",
        }
        self.put(files[LIDAR], scan(frame.cloud, T_level_camera).tobytes())
        default_us = len(self._poses) // 2 * STEP_US
        time_us = self._shifted(key, default_us if frame.timestamp_ns is None else frame.timestamp_ns // 1000)
        sample = token("sample", item.recording, frame.key)
        follow(self._samples[key], sample, timestamp=time_us, scene_token=token("scene", *key))
        ego = RigidTransform.identity() if world is None else world * T_level_camera.inv()
        for channel, T in ((CAMERA, T_level_camera), (LIDAR, RigidTransform.identity())):
            data = token("data", channel, item.recording, frame.key)
            self._poses.append({"token": data, "timestamp": time_us} | _pose(ego, "rotation", "translation"))
            is_image = channel == CAMERA
            follow(
                self._data[key, channel],
                data,
                sample_token=sample,
                ego_pose_token=data,
                calibrated_sensor_token=self._calibrated(channel, T, camera),
                timestamp=time_us,
                fileformat=files[channel].rpartition(".")[2] if is_image else "pcd",
                is_key_frame=True,
                height=camera.height_px if is_image else 0,
                width=camera.width_px if is_image else 0,
                filename=files[channel],
            )
        self._annotate(item, sample, T_level_camera if world is None else world)
        self.counts.update(label.label for label in item.labels)

    def finish(self) -> None:
        self.losses.add(Lost.UNPOSED, sum(placed[False] for placed in self._placed.values() if placed[True]))
        for name, rows in self._tables().items():
            self.put(f"{VERSION}/{name}.json", to_json(rows, indent=0) + b"\n")
        splits = defaultdict[str, list[str]](list)
        for (_, split), name in self._scene_names().items():
            if split is not None:
                splits[split].append(name)
        if splits:
            self.put(f"{VERSION}/{SPLITS}", json.dumps(splits, indent=1) + "\n")

    def _tables(self) -> dict[str, list[Part]]:
        """Returns the rows of every table, by the table's name."""
        names = self._scene_names()
        logs = [self._log(key) for key in names]
        no_map = {"token": token("map"), "log_tokens": [log["token"] for log in logs]}
        return {
            "category": [_named("category", name) for name in self.info.classes],
            "attribute": [_named("attribute", name) for name in sorted(self._attributes)],
            "visibility": [{"token": name, "level": level, "description": ""} for name, (_, level) in SHARES.items()],
            "instance": [
                {"token": instance, "category_token": token("category", label)}
                | _span("annotation", self._boxes[instance])
                | {"track_id": track_id}
                for instance, (label, track_id) in self._instances.items()
            ],
            "sensor": [
                {"token": token("sensor", channel), "channel": channel, "modality": modality}
                for channel, modality in ((CAMERA, "camera"), (LIDAR, "lidar"))
            ],
            "calibrated_sensor": list(self._calibrations.values()),
            "ego_pose": self._poses,
            "log": logs,
            "scene": [
                {"token": token("scene", *key), "log_token": token("log", *key)}
                | _span("sample", self._samples[key])
                | {"name": name, "description": f"recording {key[0]}"}
                for key, name in names.items()
            ],
            "sample": [row for rows in self._samples.values() for row in rows],
            "sample_data": [row for rows in self._data.values() for row in rows],
            "sample_annotation": self._annotations,
            "map": [no_map | {"category": "semantic_prior", "filename": MAP_FILE}],
        }

    def _scene_names(self) -> dict[Key, str]:
        """Returns the name of each scene; a scene is a recording, or the frames of it in one part of the dataset."""
        parts = Counter(recording for recording, _ in self._samples)
        names = FileNames()
        return {
            (recording, split): names.add(recording, split) if split and parts[recording] > 1 else names.add(recording)
            for recording, split in self._samples
        }

    def _shifted(self, key: Key, time_us: int) -> int:
        """Returns the time, shifted by a few microseconds if another scene begins at the same time.

        The devkit sorts scenes by their start and fails on equal ones.
        """
        if key not in self._shifts_us:
            start_us = next(each for each in count(time_us) if each not in self._starts_us)
            self._starts_us.add(start_us)
            self._shifts_us[key] = start_us - time_us
        return time_us + self._shifts_us[key]

    def _calibrated(self, channel: str, T_ego_sensor: RigidTransform, camera: Camera) -> str:
        """Adds the row of a calibrated sensor unless an equal one exists, and returns its token."""
        matrix = camera.matrix.tolist() if channel == CAMERA else []
        name = token("calibrated", channel, T_ego_sensor.as_matrix().tolist(), matrix)
        pose = _pose(T_ego_sensor, "translation", "rotation")
        self._calibrations[name] = {
            "token": name,
            "sensor_token": token("sensor", channel),
            **pose,
            "camera_intrinsic": matrix,
        }
        return name

    def _annotate(self, item: DatasetItem, sample: str, T_global_camera: RigidTransform) -> None:
        xyz = item.frame.cloud.xyz_m
        sight = Sight(xyz)
        seen: Counter[tuple[object, ...]] = Counter()
        for label in item.labels:
            identity = ("label", label.uid) if label.track_id is None else ("track", label.track_id)
            # an instance occurs once per sample, even if two labels have the same track
            seen[label.label, *identity] += 1
            occurrence = seen[label.label, *identity]
            instance = token("instance", item.recording, item.split, label.label, *identity, occurrence)
            self._instances.setdefault(instance, (label.label, label.track_id))
            box = label.box.transformed(T_global_camera)
            # with a given level, too, so that an import can tell it from a measured one
            names = dotted(label.attributes)
            self._attributes |= set(names)
            row = follow(
                self._boxes[instance],
                token("annotation", sample, instance),
                sample_token=sample,
                instance_token=instance,
                visibility_token=LEVELS.get(str(label.attributes.get(VISIBILITY))) or _visibility(sight, label),
                attribute_tokens=[token("attribute", name) for name in names],
                translation=vector(box.center_m),
                size=box.size_m[[1, 0, 2]].tolist(),
                rotation=quaternion(box.T_camera_box.rotation),
                num_lidar_pts=int(np.count_nonzero(contains(label.box, xyz))),
                num_radar_pts=0,
            )
            self._annotations.append(row)

    def _log(self, key: Key) -> Part:
        """Returns the row of a drive; its date is 1970-01-01 if the recording has no times."""
        day = datetime.fromtimestamp(self._samples[key][0]["timestamp"] / 1e6, UTC).date().isoformat()
        head = {"token": token("log", *key), "logfile": key[0], "vehicle": ""}
        return head | {"date_captured": day, "location": "unknown"}


def follow(rows: list[Part], name: str, **fields: object) -> Part:
    """Appends a row with the token `name`; it and the one before refer to each other."""
    row = {"token": name, "prev": rows[-1]["token"] if rows else "", "next": "", **fields}
    if rows:
        rows[-1]["next"] = name
    rows.append(row)
    return row


def _named(table: str, name: str) -> Part:
    return {"token": token(table, name), "name": name, "description": ""}


def _span(what: str, rows: Sequence[Part]) -> Part:
    """The number of rows, and the first and the last one."""
    first, last = rows[0]["token"], rows[-1]["token"]
    return {f"nbr_{what}s": len(rows), f"first_{what}_token": first, f"last_{what}_token": last}


def _pose(T: RigidTransform, *names: str) -> Part:
    parts = {"translation": vector(T.translation), "rotation": quaternion(T.rotation)}
    return {name: parts[name] for name in names}


def _visibility(sight: Sight, label: Label) -> str:
    """Returns the visibility level of an object: the lowest one if there is no line of sight to it."""
    share = sight.hidden(label.box).share
    seen = 0.0 if isnan(share) else 1.0 - share
    return max(name for name, (least, _) in SHARES.items() if seen >= least)
