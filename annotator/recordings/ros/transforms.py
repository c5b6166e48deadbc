"""The tree of frames that tf messages describe (`tf2_msgs/TFMessage`, `foxglove.FrameTransform`), and which way is up.

A link is the pose of a frame in its parent; it is interpolated between the messages before and after a time, as tf2
does. Links of `/tf_static` hold at all times. Only messages near a time are read. An IMU at rest (`sensor_msgs/Imu`)
says the direction against gravity.

In RealSense's own recordings (ROS 1 bags of librealsense), each stream is a frame, whose pose is in a topic of its own.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, reduce
from itertools import islice
from operator import mul
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.recordings.kinect.calibration import MOST_SAMPLES, WITHIN_NS, up_at_rest
from annotator.recordings.plausible import are_plausible
from annotator.recordings.poses import between, rigid
from annotator.recordings.ros.bag import Bag, Topic
from annotator.recordings.ros.messages import FIELD_ERRORS, SECOND, frame_id, message, stamp_ns

TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage", "foxglove/FrameTransform", "foxglove/FrameTransforms")
STATIC = "static"
# RealSense's topics of a stream's messages, and of its pose relative to the other streams
STREAM = re.compile(r"(/device_\d+/sensor_\d+/\w+_\d+)/\w+/data")
STREAM_POSE = re.compile(r"(/device_\d+/sensor_\d+/\w+_\d+)/tf/0")
# Messages within these distances of a time are read, the next larger one if the first does not suffice.
WINDOWS_NS = (SECOND // 10, SECOND, 10 * SECOND)
# A link that was last known this long ago is taken as it was.
LONGEST_GAP_NS = SECOND // 10
MOST_MESSAGES = 20_000
# parent, child, time, place, quaternion
Link = tuple[str, str, int, np.ndarray, np.ndarray]
Value = TypeVar("Value")


class LinkMissingError(Exception):
    """No chain of links leads from one frame to another at a time; the message names the gap."""


def frame_in(topic: Topic, content: Any) -> str:
    stream = STREAM.fullmatch(topic.name)
    return frame_id(content) if stream is None else stream[1]


@dataclass(eq=False)
class Links:
    """The links known around a time, each by the child's name.

    Attributes:
        static: poses in the parent, at all times.
        poses: poses in the parent by time, ns: place, metres, and quaternion.
        invalid: what is wrong with a pose that was left out.
    """

    static: dict[str, RigidTransform] = field(default_factory=dict)
    parents: dict[str, str] = field(default_factory=dict)
    poses: dict[str, dict[int, tuple[np.ndarray, np.ndarray]]] = field(default_factory=dict)
    invalid: dict[str, str] = field(default_factory=dict)

    def add(self, parent: str, child: str, time_ns: int | None, place_m: np.ndarray, quaternion: np.ndarray) -> None:
        """Adds a pose, without a time a static one; invalid ones are left out, and told where a link is missing."""
        if parent == child or child in self.static:
            return
        length = float(np.linalg.norm(quaternion))
        if not (abs(length - 1) < 0.1 and are_plausible(place_m)):
            self.invalid[child] = (
                f"the bag's transform from {child} to {parent} is invalid (a quaternion of length {length:g}, place "
                f"{' '.join(f'{value:g}' for value in place_m)})"
            )
            return
        if self.parents.get(child, parent) != parent:
            # a frame with another parent now: its former poses do not hold
            self.poses.pop(child, None)
        self.parents[child] = parent
        if time_ns is None:
            self.static[child] = rigid(place_m, quaternion)
        else:
            self.poses.setdefault(child, {})[time_ns] = (place_m, quaternion)

    def transform(self, target: str, source: str, time_ns: int) -> RigidTransform:
        """Returns `T_target_source` at a time."""
        if target == source:
            return RigidTransform.identity()
        above_source, above_target = list(self._ancestors(source)), list(self._ancestors(target))
        common = next((name for name in above_source if name in above_target), None)
        if common is None:
            raise LinkMissingError(self._gap(target, source, above_target[-1], above_source[-1]))
        T_common_source = self._chain(above_source[: above_source.index(common)], time_ns)
        T_common_target = self._chain(above_target[: above_target.index(common)], time_ns)
        return T_common_target.inv() * T_common_source

    def _chain(self, names: list[str], time_ns: int) -> RigidTransform:
        poses = [self._pose(name, time_ns) for name in reversed(names)]
        return reduce(mul, poses) if poses else RigidTransform.identity()

    def is_below(self, name: str, above: str) -> bool:
        return above in self._ancestors(name)

    def top(self, name: str) -> str:
        """Returns the frame that is above all others of `name`."""
        return list(self._ancestors(name))[-1]

    def _ancestors(self, name: str) -> Iterator[str]:
        seen: set[str] = set()
        while name not in seen:
            yield name
            seen.add(name)
            name = self.parents.get(name, name)

    def _pose(self, child: str, time_ns: int) -> RigidTransform:
        if child in self.static:
            return self.static[child]
        poses = self.poses[child]
        times = sorted(poses)
        after = int(np.searchsorted(times, time_ns))
        if 0 < after < len(times):
            before_ns, after_ns = times[after - 1], times[after]
            share = (time_ns - before_ns) / (after_ns - before_ns)
            return between(rigid(*poses[before_ns]), rigid(*poses[after_ns]), share)
        nearest = times[min(after, len(times) - 1)]
        if abs(nearest - time_ns) > LONGEST_GAP_NS:
            raise LinkMissingError(
                f"the transform from {child} to {self.parents[child]} is not known at this time; "
                f"the nearest is {abs(nearest - time_ns) / SECOND:.2f} s away"
            )
        return rigid(*poses[nearest])

    def _gap(self, target: str, source: str, top_target: str, top_source: str) -> str:
        missing = f"the transform from {source} to {target} is missing"
        for top in (top_source, top_target):
            if top in self.invalid:
                return f"{missing}: {self.invalid[top]}"
        if not self.parents:
            return f"{missing}: the bag has no tf"
        known = ", ".join(sorted(self.parents.keys() | set(self.parents.values()))[:12])
        return (
            f"{missing}: {source} hangs from {top_source}, {target} from {top_target}, and no link joins these two (tf "
            f"has {known})"
        )


@dataclass(frozen=True, eq=False)
class TransformReader:
    """Reads the links of a bag around a time; those of the topics `static` hold at all times."""

    static: tuple[Topic, ...]
    moving: tuple[Topic, ...]

    @staticmethod
    def of(bag: Bag) -> TransformReader:
        topics = bag.of_type(*TYPES)
        static = [topic for topic in topics if STATIC in topic.name]
        moving = tuple(topic for topic in topics if topic not in static)
        poses = (topic for name, topic in sorted(bag.topics.items()) if STREAM_POSE.fullmatch(name))
        return TransformReader((*static, *poses), moving)

    def look_up(self, log_ns: int, what: Callable[[Links], Value], windows: int | None = None) -> Value:
        """Returns what the links known around a log time give, of the nearest messages that suffice.

        `windows`: number of distances that are tried; 2 = within a second. Raises LinkMissingError as `what` does.
        """
        problem = LinkMissingError("the bag has too many transforms at this time")
        for links in islice(self.windows(log_ns), windows):
            try:
                return what(links)
            except LinkMissingError as error:
                problem = error
        raise problem

    def windows(self, log_ns: int) -> Iterator[Links]:
        """Yields the links known around a log time, each time with more messages, until all have been read."""
        read = -1
        for window_ns in (*WINDOWS_NS, None):
            ranges = [
                range(len(topic)) if window_ns is None else topic.between(log_ns - window_ns, log_ns + window_ns)
                for topic in self.moving
            ]
            count = sum(map(len, ranges))
            if count == read or count > MOST_MESSAGES:
                continue
            read = count
            static = self._static_links
            links = Links(static.static, dict(static.parents), invalid=dict(static.invalid))
            for topic, numbers in zip(self.moving, ranges, strict=True):
                for i in numbers:
                    for parent, child, time_ns, place_m, quaternion in _read_links(topic, i):
                        links.add(parent, child, time_ns, place_m, quaternion)
            yield links

    @cached_property
    def _static_links(self) -> Links:
        links = Links()
        for topic in self.static:
            for i in range(min(len(topic), MOST_MESSAGES)):
                for parent, child, _, place_m, quaternion in _read_links(topic, i):
                    links.add(parent, child, None, place_m, quaternion)
        return links


def _read_links(topic: Topic, i: int) -> Iterator[Link]:
    """Yields the links of a message, as far as it is sound; a link that is needed is reported as missing."""
    try:
        content, stream = message(topic, i), STREAM_POSE.fullmatch(topic.name)
        if stream is not None:
            # it leads from what the streams share to the stream
            T = rigid(*_place_and_turn(content)).inv()
            yield "the streams", stream[1], 0, T.translation, T.rotation.as_quat()
            return
        for link in getattr(content, "transforms", None) or [content]:
            if hasattr(link, "transform"):
                parent, child, pose = link.header.frame_id, link.child_frame_id, link.transform
            else:
                parent, child, pose = link.parent_frame_id, link.child_frame_id, link
            yield parent.lstrip("/"), child.lstrip("/"), stamp_ns(link), *_place_and_turn(pose)
    except FIELD_ERRORS:
        return


def _place_and_turn(pose: Any) -> tuple[np.ndarray, np.ndarray]:
    place, turn = pose.translation, pose.rotation
    return np.array([place.x, place.y, place.z], float), np.array([turn.x, turn.y, turn.z, turn.w], float)


def up_near(topic: Topic, log_ns: int) -> tuple[Float64[np.ndarray, "3"] | None, str]:
    """Returns the unit vector against gravity at a log time, and the tf frame in which it is given.

    The vector is None if the sensor moves, or no message with an acceleration is near.
    """
    near = topic.between(log_ns - WITHIN_NS, log_ns + WITHIN_NS)
    samples, frame = [], ""
    for i in sorted(near, key=lambda i: abs(int(topic.log_ns[i]) - log_ns))[:MOST_SAMPLES]:
        try:
            content = message(topic, i)
            felt = content.linear_acceleration
            samples.append((float(topic.log_ns[i]), float(felt.x), float(felt.y), float(felt.z)))
            frame = frame_in(topic, content)
        except FIELD_ERRORS:  # damaged: the others suffice
            continue
    return up_at_rest(np.array(samples).reshape(-1, 4), log_ns), frame
