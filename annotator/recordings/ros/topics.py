"""What the topics of a bag are used for: chosen where it is unambiguous, else by options.

RealSense's own recordings, ROS 1 bags of librealsense, have topics of their own:

/device_N/sensor_N/STREAM_N/image/data         images; depth is mono16
/device_N/sensor_N/STREAM_N/info/camera_info   intrinsics
/device_N/sensor_N/STREAM_N/tf/N               pose relative to the other streams of the same number (`transforms.py`)
/device_N/sensor_N/option/Depth Units/value    metres of a unit of depth
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from annotator.recordings.recording import ReaderOptions, option_flag
from annotator.recordings.ros.bag import Bag, Topic, open_bag
from annotator.recordings.ros.messages import FIELD_ERRORS, baseline_m, message
from annotator.recordings.ros.pictures import describe
from annotator.recordings.ros.transforms import TransformReader, frame_in
from annotator.types.bases import Strict
from annotator.types.errors import ConfigError, InputError, RecordingError
from annotator.types.messages import amount

IMAGE_TYPES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage", "foxglove/RawImage", "foxglove/CompressedImage")
VIDEO_TYPE = "foxglove/CompressedVideo"
CLOUD_TYPES = ("sensor_msgs/PointCloud2", "foxglove/PointCloud")
INFO_TYPES = ("sensor_msgs/CameraInfo", "foxglove/CameraCalibration")
IMU_TYPE = "sensor_msgs/Imu"
# The last part of the names of image_transport's topics, which repeat those without it.
TRANSPORTS = ("compressed", "compressedDepth", "theora", "ffmpeg", "zstd")
GREY = ("mono8", "mono16", "8UC1", "16UC1")


@dataclass(frozen=True, eq=False)
class ImageTopic:
    """A topic of images; tf frame, encoding, size and `is_depth` (see `describe`) are of its first readable message."""

    topic: Topic
    frame: str
    encoding: str
    size: tuple[int, int]
    is_depth: bool

    @property
    def base(self) -> str:
        above, _, last = self.topic.name.rpartition("/")
        return above if last in TRANSPORTS else self.topic.name

    @property
    def camera(self) -> str:
        """The part of the name that the camera's topics share."""
        return self.base.rpartition("/")[0]


Group = TypeVar("Group", Topic, ImageTopic)


@dataclass(frozen=True, eq=False)
class Chosen:
    """The topics of a recording: an image with a calibration and a cloud or depth image, or a cloud alone."""

    image: ImageTopic | None
    info: Topic | None
    points: Topic | None
    depth: ImageTopic | None
    depth_info: Topic | None

    @property
    def partner(self) -> Topic:
        partner = self.points or (self.depth.topic if self.depth else None)
        assert partner is not None
        return partner


# Opening a bag asks several times; bags are cached.
@lru_cache(maxsize=16)
def image_topics(bag: Bag) -> list[ImageTopic]:
    """Returns the topics of images that have a readable message."""
    found = []
    for topic in bag.of_type(*IMAGE_TYPES, VIDEO_TYPE):
        with suppress(*FIELD_ERRORS):
            first = first_message(topic)
            found.append(ImageTopic(topic, frame_in(topic, first), *describe(first, topic.name)))
    return found


@lru_cache(maxsize=256)
def frame_of(topic: Topic) -> str:
    """Returns the tf frame of a topic's first readable message; "" without one."""
    try:
        return frame_in(topic, first_message(topic))
    except FIELD_ERRORS:
        return ""


def first_message(topic: Topic) -> Any:
    for i in range(min(len(topic), 5)):
        try:
            return message(topic, i)
        except ValueError:
            continue
    return None


def choose(bag: Bag, options: ReaderOptions) -> Chosen:
    if options.points is not None and options.depth is not None:
        raise ConfigError(f"{bag.path}: --points and --depth exclude each other; give one of them")
    images, clouds = image_topics(bag), bag.of_type(*CLOUD_TYPES)
    image = _image(bag, options.image, images)
    if image is None:
        return Chosen(None, None, _named(bag, "points", options.points, clouds) or _only_cloud(bag, clouds), None, None)
    info = _info(bag, image, images, "camera_info", options.camera_info)
    points, depth = _partner(bag, options, image, images, clouds)
    if depth is None:
        if options.depth_info is not None:
            raise ConfigError(f"{bag.path}: {option_flag('depth_info')} is for depth images, but points are used")
        return Chosen(image, info, points, None, None)
    return Chosen(image, info, points, depth, _info(bag, depth, images, "depth_info", options.depth_info))


def _image(bag: Bag, name: str | None, images: Sequence[ImageTopic]) -> ImageTopic | None:
    """Returns the named image, or the only one of the best kind: in colour, neither infrared nor grey."""
    topic = _named(bag, "image", name, [image.topic for image in images])
    candidates = _without_repeats([image for image in images if not image.is_depth])
    if topic is not None:
        candidates = [image for image in images if image.topic is topic]

    def likeness(image: ImageTopic) -> tuple[bool, bool]:
        is_infrared = any(word in image.topic.name.lower() for word in ("infra", "/ir/", "/ir_"))
        return is_infrared, image.encoding in GREY

    best = [image for image in candidates if likeness(image) == min(map(likeness, candidates))]
    if len(best) > 1:
        raise _ambiguous(bag, image=[image.topic for image in best])
    return best[0] if best else None


def _without_repeats(images: Sequence[ImageTopic]) -> list[ImageTopic]:
    """Leaves out images that another transport repeats; uncompressed ones are preferred, then those with most."""
    best: dict[str, ImageTopic] = {}
    for image in sorted(images, key=lambda image: (image.topic.name != image.base, -len(image.topic))):
        best.setdefault(image.base, image)
    return list(best.values())


def _only(*groups: list[Group]) -> list[Group]:
    """Returns the first group of one, or the last group."""
    return next((group for group in groups if len(group) == 1), groups[-1])


def _partner(
    bag: Bag, options: ReaderOptions, image: ImageTopic, images: list[ImageTopic], clouds: list[Topic]
) -> tuple[Topic | None, ImageTopic | None]:
    if options.points is not None:
        return _named(bag, "points", options.points, clouds), None
    if options.depth is not None:
        # 16-bit grey is taken as depth if the operator says so
        topic = _named(bag, "depth", options.depth, [one.topic for one in images])
        return None, next(one for one in images if one.topic is topic)
    depths = _without_repeats([one for one in images if one.is_depth])
    same = [depth for depth in depths if depth.frame == image.frame and image.frame]
    # depth that was registered to these images
    registered = [depth for depth in same if depth.size == image.size]
    # in the same namespace, but not at the top: `/left/color` and `/left/depth`
    above = image.camera.rpartition("/")[0]
    depths = _only(registered, same, [one for one in depths if one.camera.rpartition("/")[0] == above != ""], depths)
    frames = {depth.frame for depth in depths} | {image.frame}
    # clouds that the camera's driver made of the depth
    clouds = [cloud for cloud in clouds if not depths or frame_of(cloud) not in frames]
    if len(depths) + len(clouds) > 1:
        raise _ambiguous(bag, points=clouds, depth=[depth.topic for depth in depths])
    if not depths and not clouds:
        raise RecordingError(
            f"{bag.path}: has images of {image.topic.name}, but neither point clouds (PointCloud2) nor depth images; "
            "record one of these, too"
        )
    return (clouds[0], None) if clouds else (None, depths[0])


def _info(bag: Bag, image: ImageTopic, images: list[ImageTopic], option: str, name: str | None) -> Topic:
    """Returns the calibration of an image topic: the one beside it, that of its tf frame, or one that no other has."""
    infos = bag.of_type(*INFO_TYPES)
    named = _named(bag, option, name, infos)
    if named is not None:
        return named

    def beside(one: ImageTopic) -> list[Topic]:
        # RealSense has .../Depth_0/image/data and .../Depth_0/info/camera_info
        places = (one.camera, one.camera.rpartition("/")[0] + "/info")
        return [info for info in infos if info.name.rpartition("/")[0] in places]

    same_frame = [info for info in infos if image.frame and frame_of(info) == image.frame]
    taken = {info.name for other in images if other.base != image.base for info in beside(other)}
    free = [info for info in infos if info.name not in taken]
    found = _only(beside(image), same_frame, free, beside(image) or same_frame or infos)
    if not found:
        raise RecordingError(
            f"{bag.path}: has no calibration of {image.topic.name} (CameraInfo); record its camera_info topic, too"
        )
    if len(found) > 1:
        raise _ambiguous(bag, **{option: found})
    return found[0]


@lru_cache(maxsize=16)
def first_of_pair(bag: Bag, info: Topic) -> Topic | None:
    """Returns the calibration of a stereo pair's first camera for that of the second one; None if it is not one.

    The second one's P has a baseline. Its tf frame is the first one's, as `sensor_msgs/CameraInfo` asks for; if it is a
    frame of its own, tf has the baseline already.
    """
    frame = frame_of(info)
    with suppress(*FIELD_ERRORS):
        if frame and baseline_m(first_message(info)).any():
            others = [one for one in bag.of_type(*INFO_TYPES) if one is not info and frame_of(one) == frame]
            firsts = [other for other in others if not baseline_m(first_message(other)).any()]
            return firsts[0] if len(firsts) == 1 else None
    return None


def _only_cloud(bag: Bag, clouds: list[Topic]) -> Topic:
    if not clouds:
        has = ", ".join(sorted({topic.type for topic in bag.topics.values() if len(topic)})[:12]) or "no messages"
        raise RecordingError(
            f"{bag.path}: has neither images nor point clouds that can be read; it has {has}. "
            f"Known are {', '.join((*IMAGE_TYPES, VIDEO_TYPE, *CLOUD_TYPES))}"
        )
    if len(clouds) > 1:
        raise _ambiguous(bag, points=clouds)
    return clouds[0]


def _named(bag: Bag, option: str, name: str | None, candidates: Sequence[Topic]) -> Topic | None:
    if name is None:
        return None
    found = next((topic for topic in candidates if name in (topic.name, topic.name.lstrip("/"))), None)
    if found is None:
        kind = f"is a {bag.topics[name].type}" if name in bag.topics else "is not in the bag"
        known = ", ".join(topic.name for topic in candidates) or "none"
        raise ConfigError(f"{bag.path}: {option_flag(option)} {name}: {kind}; possible are: {known}")
    return found


def _ambiguous(bag: Bag, **topics: Sequence[Topic]) -> RecordingError:
    """Returns the error that several topics could be used, by the option that names one."""
    choices = [
        f"{option_flag(option)}: " + ", ".join(f"{topic.name} ({amount(len(topic), 'message')})" for topic in found)
        for option, found in topics.items()
        if found
    ]
    return RecordingError(f"{bag.path}: choose one of its topics with {' or '.join(choices)}")


# RealSense's images of depth, and the topic with metres of a unit of it
REALSENSE_DEPTH, UNIT = re.compile(r"(/device_\d+/sensor_\d+)/Depth_\d+/image/data"), "/option/Depth Units/value"


def depth_unit_m(bag: Bag, chosen: Chosen) -> float | None:
    """Returns the metres of a unit of depth in a RealSense recording; None for other bags."""
    topic = _unit_topic(bag, chosen)
    if topic is None:
        return None
    try:
        unit_m = float(first_message(topic).data)
    except FIELD_ERRORS:  # its messages are of another type
        unit_m = 0.0
    if not 0 < unit_m < 1:
        raise RecordingError(f"{bag.path}: the unit of its depth is missing or implausible ({topic.name})")
    return unit_m


def _unit_topic(bag: Bag, chosen: Chosen | None) -> Topic | None:
    """Returns the topic of RealSense's unit, empty if it is missing; None for other bags."""
    name = "" if chosen is None or chosen.depth is None else chosen.depth.topic.name
    depth = REALSENSE_DEPTH.fullmatch(name)
    return depth and bag.topics.get(depth[1] + UNIT, Topic(depth[1] + UNIT, "", (), np.empty(0)))


class TopicReport(Strict):
    """A topic of a bag.

    Attributes:
        type: `package/Name` for all encodings.
        rate_hz: messages per second; None for fewer than two.
        use: what it is used for; "" = not used, or not chosen yet.
        option: that can name it, such as "--points"; "" = none.
    """

    name: str
    type: str
    messages: int
    rate_hz: float | None
    use: str
    option: str


def list_topics(path: Path, options: ReaderOptions) -> tuple[TopicReport, ...] | None:
    """Returns the topics of the bag at `path`, by name; None if it is not a bag."""
    bag = open_bag(path)
    if bag is None:
        return None
    try:
        chosen = choose(bag, options)
    except InputError:  # whoever opens the recording gets this error
        chosen = None
    used, named = _uses(bag, chosen), {topic.name: "--camera-info" for topic in bag.of_type(*INFO_TYPES)}
    named |= {topic.name: "--points" for topic in bag.of_type(*CLOUD_TYPES)}
    named |= {image.topic.name: "--depth" if image.is_depth else "--image" for image in image_topics(bag)}
    return tuple(
        TopicReport(
            name=name, type=topic.type, messages=len(topic), rate_hz=topic.rate_hz,
            use=used.get(name, ""), option=named.get(name, ""),
        )
        for name, topic in sorted(bag.topics.items())
    )  # fmt: skip


def _uses(bag: Bag, chosen: Chosen | None) -> dict[str, str]:
    tf = TransformReader.of(bag)
    found = {topic.name: "transforms" for topic in (*tf.static, *tf.moving)}
    found |= {topic.name: "gravity" for topic in bag.of_type(IMU_TYPE)}
    if chosen is None:
        return found
    image, depth = (None if one is None else one.topic for one in (chosen.image, chosen.depth))
    roles = (
        (chosen.depth_info, "camera of the depth"), (chosen.info, "camera"), (chosen.points, "points"),
        (depth, "depth"), (image, "image"), (_unit_topic(bag, chosen), "unit of the depth"),
    )  # fmt: skip
    return found | {topic.name: role for topic, role in roles if topic is not None}
