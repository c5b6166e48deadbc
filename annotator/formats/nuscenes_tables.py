"""Writes a dataset that the nuscenes-devkit opens.

    v1.0-annotator/*.json            the tables; splits.json names the scenes of each part
    samples/CAM_FRONT/ID.png         rectified images (or .jpg)
    samples/LIDAR_TOP/ID.pcd.bin     clouds
    maps/none.png                    the map that the tables require: one black pixel
    frames.csv                       the origin of each frame

Scenes are recordings, instances are tracks. Ego and LiDAR frame are the same: the level frame at the camera (x ahead, y
left, z against gravity). The global frame is that of the recording's map coordinates; without such, it is the ego
frame, because the camera's motion is unknown.
"""

from __future__ import annotations

import json
import uuid
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from itertools import count
from math import isnan
from typing import TypeVar

import numpy as np
from pydantic import SerializeAsAny, TypeAdapter
from scipy.spatial.transform import RigidTransform

from annotator.formats import nuscenes
from annotator.formats.attributes import VISIBILITY as VISIBLE
from annotator.formats.attributes import dotted
from annotator.formats.dataset_writing import DatasetItem, DatasetWriter, FileNames
from annotator.geometry.oriented_box import contains
from annotator.geometry.outline import Sight
from annotator.geometry.projection import straightened
from annotator.geometry.transforms import level_pose
from annotator.nuscenes_tables import CalibratedSensor, EgoPose, Linked, Record, Sample, SampleData, Scene, Sensor
from annotator.types import Camera, Label

VERSION = "v1.0-annotator"
SPLITS = "splits.json"
_ROWS = TypeAdapter(list[SerializeAsAny[Record]])
# The channels that nuScenes' devkit uses.
CAMERA, LIDAR = "CAM_FRONT", "LIDAR_TOP"
MAP_FILE = "maps/none.png"
# nuScenes' levels with their least visible fraction.
VISIBILITY = {"1": (0.0, "v0-40"), "2": (0.4, "v40-60"), "3": (0.6, "v60-80"), "4": (0.8, "v80-100")}
LEVELS = {level: number for number, (_, level) in VISIBILITY.items()}
# Namespace of the tokens: the same project gives the same tables.
NAMESPACE = uuid.UUID("0b9c4a1e-7d55-5f0a-8a57-3a1a5e9be6d2")
# Interval of samples without a time, as in nuScenes.
STEP_US = 500_000

Row = TypeVar("Row", bound=Linked)
Key = tuple[str, str | None]


def token(*parts: object) -> str:
    """Returns 32 hexadecimal digits, a hash of the parts."""
    return uuid.uuid5(NAMESPACE, "\n".join(map(repr, parts))).hex


class NuScenesWriter(DatasetWriter):
    """Keeps all rows in memory, without images and clouds."""

    def begin(self) -> None:
        import cv2

        self._samples: dict[Key, list[Sample]] = {}
        self._data: dict[tuple[Key, str], list[SampleData]] = {}
        self._poses: list[EgoPose] = []
        self._calibrations: dict[str, CalibratedSensor] = {}
        self._annotations: dict[str, list[nuscenes.SampleAnnotation]] = {}
        self._instances: dict[str, tuple[str, int | None]] = {}
        self._order: list[str] = []
        self._attributes: set[str] = set()
        self._shifts_us: dict[Key, int] = {}
        self._starts_us: set[int] = set()
        self.put(MAP_FILE, cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes())

    def frame(self, item: DatasetItem, frame_id: str) -> None:
        T_level_camera = level_pose(item.frame.up)
        camera, rgb = straightened(item.frame.camera, item.frame.rgb)
        files = {
            CAMERA: self.put_image(f"samples/{CAMERA}/{frame_id}", rgb),
            LIDAR: f"samples/{LIDAR}/{frame_id}.pcd.bin",
        }
        self.put(files[LIDAR], nuscenes.scan(item.frame.cloud, T_level_camera).tobytes())
        self._add(item, camera, T_level_camera, files)
        self.counts.update(label.label for label in item.labels)

    def finish(self) -> None:
        for name, rows in self._tables().items():
            self.put(f"{VERSION}/{name}.json", _ROWS.dump_json(list(rows), indent=0) + b"\n")
        splits = defaultdict[str, list[str]](list)
        for (_, split), name in self._scene_names().items():
            if split is not None:
                splits[split].append(name)
        if splits:
            self.put(f"{VERSION}/{SPLITS}", json.dumps(splits, indent=1) + "\n")

    def _add(self, item: DatasetItem, camera: Camera, T_level_camera: RigidTransform, files: Mapping[str, str]) -> None:
        """Adds a frame.

        Args:
            camera: an ideal camera.
            T_level_camera: from the camera to the level frame, which is also the ego frame.
            files: camera and LiDAR file by channel, relative to the dataset's root.
        """
        frame, key = item.frame, (item.recording, item.split)
        default_us = len(self._poses) // 2 * STEP_US
        time_us = self._shifted(key, default_us if frame.timestamp_ns is None else frame.timestamp_ns // 1000)
        sample = Sample(
            token=token("sample", item.recording, frame.key), timestamp=time_us, scene_token=token("scene", *key)
        )
        self._samples.setdefault(key, []).append(sample)
        world = frame.T_world_camera
        ego = RigidTransform.identity() if world is None else world * T_level_camera.inv()
        for channel, T in ((CAMERA, T_level_camera), (LIDAR, RigidTransform.identity())):
            data = token("data", channel, item.recording, frame.key)
            self._poses.append(
                EgoPose(
                    token=data,
                    timestamp=time_us,
                    rotation=nuscenes.quaternion(ego.rotation),
                    translation=nuscenes.vector(ego.translation),
                )
            )
            size = (camera.width_px, camera.height_px) if channel == CAMERA else (0, 0)
            row = SampleData(
                token=data,
                sample_token=sample.token,
                ego_pose_token=data,
                calibrated_sensor_token=self._calibrated(channel, T, camera),
                timestamp=time_us,
                fileformat=files[channel].rpartition(".")[2] if channel == CAMERA else "pcd",
                is_key_frame=True,
                width=size[0],
                height=size[1],
                filename=files[channel],
            )
            self._data.setdefault((key, channel), []).append(row)
        self._annotate(item, sample, T_level_camera if world is None else world)

    def _tables(self) -> dict[str, Sequence[Record]]:
        """Returns the rows of every table, by the table's name."""
        names = self._scene_names()
        logs = {key: token("log", *key) for key in names}
        annotations = {row.token: row for rows in self._annotations.values() for row in linked(rows)}
        return {
            "category": [nuscenes.Category(token=token("category", name), name=name) for name in self.info.classes],
            "attribute": [
                nuscenes.Attribute(token=token("attribute", name), name=name) for name in sorted(self._attributes)
            ],
            "visibility": [nuscenes.Visibility(token=name, level=level) for name, (_, level) in VISIBILITY.items()],
            "instance": [self._instance(each) for each in self._instances],
            "sensor": [
                Sensor(token=token("sensor", CAMERA), channel=CAMERA, modality="camera"),
                Sensor(token=token("sensor", LIDAR), channel=LIDAR, modality="lidar"),
            ],
            "calibrated_sensor": list(self._calibrations.values()),
            "ego_pose": self._poses,
            "log": [self._log(key, logs[key]) for key in names],
            "scene": [self._scene(key, name, logs[key]) for key, name in names.items()],
            "sample": [row for rows in self._samples.values() for row in linked(rows)],
            "sample_data": [row for rows in self._data.values() for row in linked(rows)],
            "sample_annotation": [annotations[each] for each in self._order],
            "map": [nuscenes.Map(token=token("map"), log_tokens=tuple(logs.values()), filename=MAP_FILE)],
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
        rows = camera.matrix.tolist() if channel == CAMERA else []
        row = CalibratedSensor(
            token=token("calibrated", channel, T_ego_sensor.as_matrix().tolist(), rows),
            sensor_token=token("sensor", channel),
            translation=nuscenes.vector(T_ego_sensor.translation),
            rotation=nuscenes.quaternion(T_ego_sensor.rotation),
            camera_intrinsic=tuple((x, y, z) for x, y, z in rows),
        )
        self._calibrations[row.token] = row
        return row.token

    def _annotate(self, item: DatasetItem, sample: Sample, T_global_camera: RigidTransform) -> None:
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
            visibility = LEVELS.get(str(label.attributes.get(VISIBLE))) or _visibility(sight, label)
            # with a given level, too, so that an import can tell it from a measured one
            names = dotted(label.attributes)
            self._attributes |= set(names)
            row = nuscenes.SampleAnnotation(
                token=token("annotation", sample.token, instance),
                sample_token=sample.token,
                instance_token=instance,
                visibility_token=visibility,
                attribute_tokens=tuple(token("attribute", name) for name in names),
                translation=nuscenes.vector(box.center_m),
                size=nuscenes.width_length_height(box),
                rotation=nuscenes.quaternion(box.T_camera_box.rotation),
                num_lidar_pts=int(np.count_nonzero(contains(label.box, xyz))),
            )
            self._annotations.setdefault(instance, []).append(row)
            self._order.append(row.token)

    def _instance(self, instance: str) -> nuscenes.Instance:
        (label, track_id), rows = self._instances[instance], self._annotations[instance]
        return nuscenes.Instance(
            token=instance,
            category_token=token("category", label),
            nbr_annotations=len(rows),
            first_annotation_token=rows[0].token,
            last_annotation_token=rows[-1].token,
            track_id=track_id,
        )

    def _scene(self, key: Key, name: str, log: str) -> Scene:
        rows = self._samples[key]
        return Scene(
            token=token("scene", *key),
            log_token=log,
            nbr_samples=len(rows),
            first_sample_token=rows[0].token,
            last_sample_token=rows[-1].token,
            name=name,
            description=f"recording {key[0]}",
        )

    def _log(self, key: Key, log: str) -> nuscenes.Log:
        """Returns the row of a drive; its date is 1970-01-01 if the recording has no times."""
        day = datetime.fromtimestamp(self._samples[key][0].timestamp / 1e6, UTC).date().isoformat()
        return nuscenes.Log(token=log, logfile=key[0], vehicle="", date_captured=day, location="unknown")


def linked(rows: Sequence[Row]) -> list[Row]:
    """Returns consecutive rows, each with the tokens of its neighbours."""
    tokens = ["", *(row.token for row in rows), ""]
    return [row.model_copy(update={"prev": tokens[place], "next": tokens[place + 2]}) for place, row in enumerate(rows)]


def _visibility(sight: Sight, label: Label) -> str:
    """Returns the visibility level of an object: the lowest one if there is no line of sight to it."""
    share = sight.hidden(label.box).share
    seen = 0.0 if isnan(share) else 1.0 - share
    return max(name for name, (least, _) in VISIBILITY.items() if seen >= least)
