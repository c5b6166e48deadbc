"""Where a bag says that its rig was: by tf to `map`, `odom` or `world`, else by a topic of poses.

Topics: `nav_msgs/Odometry` (of the frame `child_frame_id`), `geometry_msgs/PoseStamped` and
`PoseWithCovarianceStamped`, and the last message of a `nav_msgs/Path`. The latter three do not say whose poses they
are: those of the frame on top of the sensor's in tf (`base_link`), or of the sensor in a bag without tf.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from annotator.recordings.plausible import are_plausible
from annotator.recordings.poses import MOST_OFF_UNIT, Poses
from annotator.recordings.ros.bag import Bag, Topic
from annotator.recordings.ros.messages import FIELD_ERRORS, SECOND, message, stamp_ns
from annotator.recordings.ros.topics import first_message
from annotator.recordings.ros.transforms import LinkMissingError, TransformReader

# Frames that do not move with the rig (REP 105), the best first: `map` does not drift.
WORLDS = ("map", "odom", "world")
TYPES = (
    *("nav_msgs/Odometry", "geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped"),
    "nav_msgs/Path",
)
# Of longer topics, every second, third ... message is read.
MOST_MESSAGES = 50_000


@dataclass(frozen=True, eq=False)
class BagWorld:
    """The world of a bag.

    Attributes:
        source: tf's frame, or the topic.
        frame: the tf frame that stands still, or of which the topic has poses.
        topic: None: tf knows the frame.
        times_ns: the first and the last log time of the recording's frames.
    """

    source: str
    frame: str
    tf: TransformReader
    topic: Topic | None
    times_ns: tuple[int, int]

    def T_world(self, frame: str, time_ns: int, log_ns: int) -> RigidTransform | None:
        """Returns the pose of a tf frame at a time; None if it is not known then."""
        T_world_body = RigidTransform.identity() if self.topic is None else self._poses and self._poses.at(0, time_ns)
        if T_world_body is None:
            return None
        with suppress(LinkMissingError):
            return T_world_body * self.tf.look_up(log_ns, lambda links: links.transform(self.frame, frame, time_ns), 2)
        return None

    @cached_property
    def _poses(self) -> Poses | None:
        """The topic's poses in time order, without those that are damaged or have the time of another one."""
        assert self.topic is not None
        first, last = self.times_ns
        numbers: Sequence[int] = self.topic.between(first - SECOND, last + SECOND)
        # the last message of a path has it all
        is_path = self.topic.type == "nav_msgs/Path"
        numbers = [len(self.topic) - 1] if is_path else numbers[:: len(numbers) // MOST_MESSAGES + 1]
        rows = dict[int, list[float]]()
        for number in numbers:
            with suppress(*FIELD_ERRORS):
                content = message(self.topic, number)
                for each in islice(content.poses, MOST_MESSAGES) if is_path else (content,):
                    row = list(_numbers(each))
                    is_sound = are_plausible(np.array(row)) and abs(np.hypot.reduce(row[3:]) - 1) <= MOST_OFF_UNIT
                    if is_sound:
                        rows.setdefault(stamp_ns(each) or int(self.topic.log_ns[number]), row)
        if not rows:
            return None
        table = np.array([rows[time] for time in sorted(rows)])
        return Poses(self.source, table[:, :3], table[:, 3:], np.array(sorted(rows), np.int64))


def _numbers(content: Any) -> Iterator[float]:
    pose = getattr(content.pose, "pose", content.pose)
    yield from (float(getattr(pose.position, name)) for name in "xyz")
    yield from (float(getattr(pose.orientation, name)) for name in "xyzw")


def find_world(bag: Bag, tf: TransformReader, sensor: str, log_ns: Sequence[int]) -> tuple[BagWorld | None, str]:
    """Returns what says where a tf frame is, of a bag with frames at these log times; and a note on it."""
    times_ns = log_ns[0], log_ns[-1]
    if (fixed := frame_above(tf, (sensor,), log_ns, WORLDS)) is not None:
        return BagWorld(f"tf ({fixed})", fixed, tf, None, times_ns), ""
    found = list[tuple[tuple[int, int, int], Topic, str]]()
    for topic in bag.of_type(*TYPES):
        with suppress(*FIELD_ERRORS):
            content = first_message(topic)
            world = str(content.header.frame_id).lstrip("/")
            rank = WORLDS.index(world) if world in WORLDS else len(WORLDS)
            body = str(getattr(content, "child_frame_id", "")).lstrip("/")
            found.append(((TYPES.index(topic.type), rank, -len(topic)), topic, body))
    if not found:
        return None, ""
    _, topic, said = min(found, key=lambda each: each[0])
    body = said or _top(tf, sensor, log_ns)
    if body != sensor and frame_above(tf, (sensor,), log_ns, (body,)) is None:
        return None, f"the poses of {topic.name} are those of {body}, and tf does not say how {sensor} is mounted on it"
    others = f" ({len(found) - 1} other topics have poses)" if len(found) > 1 else ""
    note = f"poses: {topic.name}{others}, " + ("" if said else "which do not say whose they are, taken as ")
    return BagWorld(topic.name, body, tf, topic, times_ns), f"{note}those of {body}"


def frame_above(
    tf: TransformReader, frames: Sequence[str], log_ns: Sequence[int], candidates: Sequence[str]
) -> str | None:
    """Returns the first candidate from which all these tf frames hang, at least at times; None without one."""
    for time_ns in (log_ns[0], log_ns[len(log_ns) // 2], log_ns[-1]):
        for links in islice(tf.windows(time_ns), 2):
            for above in candidates:
                if all(links.is_below(frame, above) for frame in frames):
                    return above
    return None


def _top(tf: TransformReader, frame: str, log_ns: Sequence[int]) -> str:
    return next((links.top(frame) for links in tf.windows(log_ns[0])), frame)
