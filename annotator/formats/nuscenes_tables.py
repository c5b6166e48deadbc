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
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import count
from math import isnan
from typing import Any

import numpy as np
from pydantic_core import to_json
from scipy.spatial.transform import RigidTransform

from annotator.formats.attributes import VISIBILITY, dotted
from annotator.formats.dataset_writing import DatasetItem, DatasetWriter, FileNames
from annotator.formats.nuscenes import quaternion, scan, vector, width_length_height
from annotator.geometry.oriented_box import contains
from annotator.geometry.outline import Sight
from annotator.geometry.projection import straightened
from annotator.geometry.transforms import level_pose
from annotator.types import Camera, Label

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
        self.put(MAP_FILE, cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes())

    def frame(self, item: DatasetItem, frame_id: str) -> None:
        frame, key = item.frame, (item.recording, item.split)
        T_level_camera, world = level_pose(frame.up), frame.T_world_camera
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
                size=width_length_height(box),
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
