"""RealSense's own recordings: ROS 1 bags of librealsense with topics of its own.

/device_N/sensor_N/STREAM_N/image/data         images; depth is mono16
/device_N/sensor_N/STREAM_N/info               StreamInfo: fps
/device_N/sensor_N/STREAM_N/info/camera_info   intrinsics
/device_N/sensor_N/STREAM_N/tf/N               pose relative to the other streams of the same number
/device_N/sensor_N/option/Depth Units/value    metres of a unit of depth
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.recordings.plausible import are_plausible
from annotator.recordings.ros.bag import Bag, Topic
from annotator.recordings.ros.messages import FIELD_ERRORS
from annotator.recordings.ros.roles import IMU_TYPE, Chosen, first_message
from annotator.types.errors import RecordingError

DEPTH = re.compile(r"(/device_\d+/sensor_\d+)(/Depth_\d+)/image/data")
STREAM = re.compile(r"(/device_\d+/sensor_\d+/\w+_\d+)/\w+/data")
UNIT, POSE = "/option/Depth Units/value", "/tf/0"
DEFAULT_FPS = 30


@dataclass(frozen=True, eq=False)
class RealSense:
    """What a recording says about its depth camera.

    Attributes:
        unit_m: metres of a unit of depth.
        T_color_depth: from the depth camera to the colour camera.
        period_s: between two depth images.
    """

    unit_m: float
    T_color_depth: RigidTransform
    period_s: float


def realsense_of(bag: Bag, chosen: Chosen) -> RealSense | None:
    """Returns what a RealSense recording says; None for other bags.

    Raises:
        RecordingError: the unit or a pose is missing or implausible.
    """
    if chosen.depth is None or chosen.image is None:
        return None
    depth = DEPTH.fullmatch(chosen.depth.topic.name)
    if depth is None:
        return None
    try:
        unit_m = float(_first(bag, depth[1] + UNIT).data)
        fps = int(getattr(_first(bag, depth[1] + depth[2] + "/info"), "fps", 0)) or DEFAULT_FPS
    except FIELD_ERRORS:  # the topic is missing, or its messages are of another type
        unit_m, fps = 0.0, DEFAULT_FPS
    if not 0 < unit_m < 1:
        raise RecordingError(f"{bag.path}: the unit of its depth is missing or implausible ({depth[1] + UNIT})")
    return RealSense(unit_m, between_streams(bag, chosen.image.topic, chosen.depth.topic), 1 / max(fps, 1))


def realsense_uses(bag: Bag, chosen: Chosen | None) -> dict[str, str]:
    """Returns what RealSense's own topics are used for, by name; empty for other bags."""
    if chosen is None or chosen.depth is None or chosen.image is None:
        return {}
    depth = DEPTH.fullmatch(chosen.depth.topic.name)
    if depth is None:
        return {}
    names = [topic.name for topic in (chosen.image.topic, chosen.depth.topic, *bag.of_type(IMU_TYPE))]
    streams = (stream[1] for name in names if (stream := STREAM.fullmatch(name)))
    return {
        depth[1] + UNIT: "unit of the depth",
        depth[1] + depth[2] + "/info": "rate of the depth",
        **{stream + POSE: "transforms" for stream in streams},
    }


def between_streams(bag: Bag, target: Topic, source: Topic) -> RigidTransform:
    """Returns `T_target_source` of two streams.

    Raises:
        RecordingError: their poses are missing or damaged.
    """
    return _pose(bag, target) * _pose(bag, source).inv()


def _pose(bag: Bag, topic: Topic) -> RigidTransform:
    """Returns the transform from the reference of a stream's group to the stream."""
    stream = STREAM.fullmatch(topic.name)
    content = None if stream is None else _first(bag, stream[1] + POSE)
    if content is None:
        raise RecordingError(f"{bag.path}: the pose of {topic.name} is missing (tf/0 of its stream)")
    try:
        place = np.array([float(getattr(content.translation, axis)) for axis in "xyz"])
        turn = np.array([float(getattr(content.rotation, axis)) for axis in "xyzw"])
    except FIELD_ERRORS:  # messages of another type
        place = turn = np.full(4, np.nan)
    if not are_plausible(place) or not abs(np.linalg.norm(turn) - 1) < 1e-2:
        raise RecordingError(f"{bag.path}: the pose of {topic.name} is not a rotation and a translation")
    return RigidTransform.from_components(place, Rotation.from_quat(turn))


def _first(bag: Bag, name: str) -> Any:
    topic = bag.topics.get(name)
    return None if topic is None or not len(topic) else first_message(topic)
