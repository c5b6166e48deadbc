"""Bags as recordings: an image topic with a cloud or depth topic, or a topic of clouds alone.

Frames are pairs of messages; their keys are the numbers of the images on their topic (without images, of the clouds).
A frame's cloud holds the points that its camera sees, in the camera's frame, by the tf messages of the bag. Where tf
knows how the rig moves (`odom`, `map` or `world`), a cloud is moved from its own time to that of the image, unless the
option `no_motion` is given.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.projection import pixel_colors, unproject_depth
from annotator.geometry.transforms import FORWARD
from annotator.recordings.clouds.cloud_folder import T_CAMERA_LIDAR, VIRTUAL_CAMERA
from annotator.recordings.clouds.columns import FIRST, CommonScale, RawCloud
from annotator.recordings.clouds.virtual_camera import Origin, virtual_image, without_strays, world_pose
from annotator.recordings.image_file import Levels
from annotator.recordings.kitti import UP, visible_cloud
from annotator.recordings.look_around import Scan, Scanned, level_turn
from annotator.recordings.recording import Place, ReaderOptions, Recording, option_flag
from annotator.recordings.ros.bag import Bag, Topic, open_bag
from annotator.recordings.ros.messages import (
    FIELD_ERRORS,
    RECTIFIED,
    BagCamera,
    cloud_of,
    frame_id,
    message,
    read_camera_info,
)
from annotator.recordings.ros.pairing import Pairs, pair, stamps_ns
from annotator.recordings.ros.pictures import color_image, depth_image, levels_of, video_image
from annotator.recordings.ros.topics import (
    IMU_TYPE,
    VIDEO_TYPE,
    Chosen,
    ImageTopic,
    RealSense,
    between_streams,
    choose,
    first_of_pair,
    frame_of,
    realsense_of,
)
from annotator.recordings.ros.transforms import LinkMissingError, TransformReader, up_near
from annotator.recordings.two_cameras import registered
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import ConfigError, FrameError, GeometryError, RecordingError

TOLERANCE_S = 0.05
# Frames that do not move with the rig (REP 105).
FIXED_FRAMES = ("odom", "map", "world")
REMEDY = "record it again, or use the other frames"
SAME_K_PX = 1e-3
# Up in a level LiDAR's frame.
Z = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class RosBag(Recording):
    """A `Recording` of a bag.

    Attributes:
        bag: the open bag.
        chosen: the topics that are used.
        pairs: their messages.
        tf: reads the bag's transforms.
        camera_frame: tf frame of the camera; "" = that of its images.
        fixed_frame: tf frame by which clouds are moved; None if tf does not know how the rig moves.
        realsense: what RealSense's own topics say; None for other bags.
        told: the recording's notes.
        scale: of the clouds' reflectance and colours.
        levels: of the first pictures of a topic.
        given_origin: the option `origin`, for clouds without images.
    """

    bag: Bag
    chosen: Chosen
    pairs: Pairs
    tf: TransformReader
    camera_frame: str
    fixed_frame: str | None
    realsense: RealSense | None
    told: tuple[str, ...]
    scale: CommonScale = field(default_factory=CommonScale)
    levels: dict[Topic, list[Levels]] = field(default_factory=dict)
    given_origin: Place | None = None
    format: ClassVar[str] = "ros_bag"
    is_sequence: ClassVar[bool] = True

    @property
    def name(self) -> str:
        path = self.path.resolve()
        return path.stem if path.is_file() else path.name

    @property
    def notes(self) -> tuple[str, ...]:
        return (*self.told, *self._origin.notes)

    @property
    def times_ns(self) -> tuple[int, ...]:
        """The frames' times."""
        return tuple(self.pairs.time_ns.tolist())

    def frame(self, i: int) -> Frame:
        """Reads frame `i`; from depth images, with `depth_m`."""
        with self._errors(i) as key:
            if self.chosen.image is None:
                return self._cloud_frame(key, i)
            return self._image_frame(key, i, self.chosen.image)

    @contextmanager
    def _errors(self, i: int) -> Iterator[str]:
        """Gives the key of frame `i`; errors within the block become those of that frame."""
        key = self.key(i)
        try:
            yield key
        except OSError as error:
            raise FrameError(self.path, f"frame {key}: cannot be read ({error.strerror})", REMEDY) from error
        except (*FIELD_ERRORS, LinkMissingError, GeometryError) as error:
            raise FrameError(self.path, f"frame {key}: {error}", REMEDY) from error

    def _cloud_frame(self, key: str, i: int) -> Frame:
        raw = self._raw(int(self.pairs.cloud[i]))
        place_m = self._origin.of(raw)
        raw = without_strays(raw, place_m)
        T = T_CAMERA_LIDAR * RigidTransform.from_translation(-place_m)
        cloud = PointCloud(T.apply(raw.xyz_m).astype(np.float32), raw.rgb, raw.reflectance)
        rgb = virtual_image(VIRTUAL_CAMERA, cloud)
        time_ns = int(self.pairs.time_ns[i])
        world = T.inv() if place_m.any() else None
        return Frame(key, i, VIRTUAL_CAMERA, rgb, cloud, None, UP, T, time_ns, T_world_camera=world)

    @property
    def origin(self) -> Place | None:
        is_map = self.chosen.image is None and self._origin.xyz_m.any()
        return tuple(self._origin.xyz_m.tolist()) if is_map else None

    @cached_property
    def _origin(self) -> Origin:
        return Origin(self.given_origin, lambda: (partial(self._raw, number) for number in map(int, self.pairs.cloud)))

    def _raw(self, number: int) -> RawCloud:
        return self._cloud(_content(self.chosen.partner, number))

    def _image_frame(self, key: str, i: int, image: ImageTopic) -> Frame:
        number = int(self.pairs.image[i])
        log_ns, time_ns = int(image.topic.log_ns[number]), int(self.pairs.time_ns[i])
        content, partner = self._contents(image.topic, number, int(self.pairs.cloud[i]))
        camera = self.camera(log_ns)
        rgb = self._picture(image.topic, number, content, camera)
        camera_frame = self.camera_frame or frame_id(content)
        depth_m, world = None, None
        if self.chosen.depth is not None:
            T = self._T_color_depth(i, camera, camera_frame, frame_id(partner), log_ns)
            cloud, depth_m = self._from_depth(partner, self.chosen.depth, T, rgb, camera.camera, log_ns)
        else:
            raw = self._cloud(partner)
            T = camera.T_camera_frame * self._T_camera_cloud(i, camera_frame, frame_id(partner), log_ns)
            xyz_m, world = T.apply(raw.xyz_m).astype(np.float32), world_pose(T)
            cloud = visible_cloud(self.path, camera.camera, xyz_m, raw, rgb, f"check tf at frame {key}")
        if len(cloud) == 0:
            raise ValueError(f"no point of {self.chosen.partner.name} lies in the image, so the cloud is empty")
        up = self._up(camera, camera_frame, time_ns, log_ns)
        return Frame(key, i, camera.camera, rgb, cloud, depth_m, up, None, time_ns, T_world_camera=world)

    def _picture(self, topic: Topic, number: int, content: Any, camera: BagCamera) -> UInt8[np.ndarray, "h w 3"]:
        with _naming(topic):
            if topic.type == VIDEO_TYPE:
                return camera.picture(video_image(topic, number, content))
            return camera.picture(color_image(content, lambda own: own.with_all(self._levels_of(topic))))

    def _levels_of(self, topic: Topic) -> list[Levels]:
        """Returns the levels of a topic's first pictures of more than 8 bits."""
        if topic not in self.levels:
            self.levels[topic] = levels_of(lambda number: message(topic, number), self.pairs.image[:FIRST].tolist())
        return self.levels[topic]

    def _contents(self, image: Topic, number: int, partner_number: int) -> tuple[Any, Any]:
        """Returns the messages of an image and of its partner."""
        partner = self.chosen.partner
        if not partner.is_slow:
            return _content(image, number), _content(partner, partner_number)
        with ThreadPoolExecutor(1) as pool:
            reading = pool.submit(_content, partner, partner_number)
            return _content(image, number), reading.result()

    def _cloud(self, content: Any) -> RawCloud:
        """Returns the cloud of a message, with the scale of reflectance that the first ones have."""
        topic, first = self.chosen.partner, self.pairs.cloud
        with _naming(topic):
            raw = cloud_of(content)
        return self.scale.apply(topic, raw, lambda: map(int, first), lambda number: cloud_of(message(topic, number)))

    def camera(self, log_ns: int) -> BagCamera:
        """Returns the camera of the images, as calibrated at a log time."""
        assert self.chosen.info is not None and self.chosen.image is not None
        return self._camera(self.chosen.info, self.chosen.image, log_ns)

    def _camera(self, info: Topic, image: ImageTopic, log_ns: int) -> BagCamera:
        """Returns a camera as its calibration says that was logged nearest to a time."""
        is_rectified = bool(RECTIFIED.search(image.base))
        first = first_of_pair(self.bag, info) if is_rectified else None
        with _naming(info):
            content = message(info, info.nearest(log_ns))
            return read_camera_info(content, is_rectified, first and message(first, first.nearest(log_ns)))

    def _from_depth(
        self, content: Any, depth: ImageTopic, T: RigidTransform, rgb: np.ndarray, camera: Camera, log_ns: int
    ) -> tuple[PointCloud, np.ndarray]:
        """Returns the cloud of a depth image and the depth in the pixels of the image."""
        assert self.chosen.depth_info is not None
        unit_m = None if self.realsense is None else self.realsense.unit_m
        with _naming(depth.topic):
            depth_m = depth_image(content, unit_m)
        source = self._camera(self.chosen.depth_info, depth, log_ns)
        if source.fisheye is not None:
            raise ValueError(f"{depth.topic.name}: depth of a fisheye camera is not supported")
        with _naming(depth.topic):
            source.require_size(depth_m.shape)
        if _are_equal(source.camera, camera) and np.allclose(T.as_matrix(), np.eye(4)):
            xyz_m, pixel = unproject_depth(camera, depth_m)
            return PointCloud(xyz_m, rgb=pixel_colors(rgb, pixel), pixel_index=pixel), depth_m
        return registered(depth_m, source.camera, T, rgb, camera)

    def _T_color_depth(
        self, i: int, camera: BagCamera, camera_frame: str, depth_frame: str, log_ns: int
    ) -> RigidTransform:
        assert self.chosen.depth is not None and self.chosen.depth_info is not None
        if self.realsense is not None:
            return self.realsense.T_color_depth
        source = self._camera(self.chosen.depth_info, self.chosen.depth, log_ns)
        between = self._T_camera_cloud(i, camera_frame, depth_frame, log_ns)
        return camera.T_camera_frame * between * source.T_camera_frame.inv()

    def _T_camera_cloud(self, i: int, camera: str, cloud: str, log_ns: int) -> RigidTransform:
        """Returns the transform of a pair: the cloud at its own time, the camera at that of the image."""
        time_ns, cloud_ns = int(self.pairs.time_ns[i]), int(self.pairs.cloud_time_ns[i])
        fixed = self.fixed_frame if time_ns != cloud_ns else None
        if camera == cloud and fixed is None:
            return RigidTransform.identity()
        problem = LinkMissingError(f"the transform from {cloud} to {camera} is missing: the bag has no tf")
        direct: RigidTransform | None = None
        for links in self.tf.windows(log_ns):
            try:
                # where the motion is not known, the rigid mount must do
                direct = links.transform(camera, cloud, time_ns)
                if fixed is None:
                    return direct
                return links.transform(camera, fixed, time_ns) * links.transform(fixed, cloud, cloud_ns)
            except LinkMissingError as error:
                problem = error
        if direct is None:
            raise problem
        return direct

    def _up(self, camera: BagCamera, camera_frame: str, time_ns: int, log_ns: int) -> Float64[np.ndarray, "3"] | None:
        for topic in self.bag.of_type(IMU_TYPE):
            found = up_near(topic, log_ns)
            if found is None:
                continue
            turn = self._imu_turn(topic, camera_frame, found[1], time_ns, log_ns)
            if turn is not None:
                return np.asarray((camera.T_camera_frame.rotation * turn).apply(found[0]))
        return None

    def _imu_turn(self, imu: Topic, camera_frame: str, frame: str, time_ns: int, log_ns: int) -> Rotation | None:
        """Returns the rotation from an IMU's axes to those of the camera; None if it is not known."""
        if self.realsense is not None and self.chosen.image is not None:
            try:
                return between_streams(self.bag, self.chosen.image.topic, imu).rotation
            except RecordingError:
                return None
        for links in self.tf.near(log_ns):
            try:
                return links.transform(camera_frame, frame, time_ns).rotation
            except LinkMissingError:
                continue
        return None


@dataclass(frozen=True, eq=False)
class ScanBag(RosBag, Scanned):
    """A bag whose partner of the images are clouds."""

    def scan(self, i: int) -> Scan:
        """Reads the whole cloud of frame `i`, ahead being where the camera looks, or x without images.

        Without an IMU, z is taken as up.
        """
        with self._errors(i):
            content = _content(self.chosen.partner, int(self.pairs.cloud[i]))
            raw = self._cloud(content)
            R_level_scan, knows_up = Rotation.identity(), True
            if self.chosen.image is None:
                place_m = self._origin.of(raw)
                raw = without_strays(raw, place_m)
            else:
                number, time_ns = int(self.pairs.image[i]), int(self.pairs.time_ns[i])
                log_ns = int(self.chosen.image.topic.log_ns[number])
                camera, frame = self.camera(log_ns), self.camera_frame or self.chosen.image.frame
                T_camera_scan = camera.T_camera_frame * self._T_camera_cloud(i, frame, frame_id(content), log_ns)
                R_scan_camera, up = T_camera_scan.rotation.inv(), self._up(camera, frame, time_ns, log_ns)
                knows_up = up is not None
                up_scan = Z if up is None else R_scan_camera.apply(up)
                R_level_scan = level_turn(up_scan, R_scan_camera.apply(FORWARD))
                T_world_camera = world_pose(T_camera_scan)
                place_m = np.zeros(3) if T_world_camera is None else T_world_camera.translation
            return Scan(
                raw, R_level_scan, place_m, RigidTransform.identity(), knows_up,
                int(self.pairs.cloud_time_ns[i]), RigidTransform.identity() if place_m.any() else None,
            )  # fmt: skip


def open_ros_bag(path: Path, options: ReaderOptions) -> RosBag | None:
    """Opens the bag at `path`, without reading images or clouds; None if it is not one."""
    bag = open_bag(path)
    if bag is None:
        return None
    chosen = choose(bag, options)
    realsense = realsense_of(bag, chosen)
    notes: tuple[str, ...] = ()
    if chosen.image is None:
        pairs = _alone(chosen.partner)
        keys, notes = (
            pairs.cloud,
            ("has no images: a virtual camera looks forward from the LiDAR, which must be level",),
        )
    else:
        if options.origin is not None:
            raise ConfigError(
                f"{path}: the images of {chosen.image.topic.name} say where the camera is, so {option_flag('origin')} "
                "is not taken; it is for bags without images"
            )
        tolerance_s = options.tolerance_s or (
            TOLERANCE_S if realsense is None else max(realsense.period_s, TOLERANCE_S)
        )
        pairs = pair(chosen.image.topic, chosen.partner, tolerance_s)
        keys = pairs.image
    if not len(keys):
        raise RecordingError(f"{path}: no frames; {'; '.join(pairs.notes)}")
    tf, camera_frame = TransformReader.of(bag), (options.tf_frame or "").lstrip("/")
    is_still = realsense or chosen.image is None or options.no_motion
    fixed = None if is_still else _fixed_frame(tf, chosen, pairs, camera_frame)
    if fixed is not None:
        notes += (
            f"clouds are moved to the images' times by the motion of the rig in {fixed} where tf knows it "
            "(not with --no-motion)",
        )
    kind = RosBag if chosen.points is None else ScanBag
    return kind(
        path, tuple(f"{number:06d}" for number in keys), bag, chosen, pairs, tf, camera_frame, fixed,
        realsense, (*bag.notes, *pairs.notes, *notes), given_origin=options.origin,
    )  # fmt: skip


def _alone(clouds: Topic) -> Pairs:
    """Returns the messages of a topic of clouds, without images."""
    stamps = stamps_ns(clouds)
    times = stamps if (stamps > 0).all() else clouds.log_ns
    order = np.argsort(times, kind="stable")
    return Pairs(order, order, times[order], times[order], ())


def _fixed_frame(tf: TransformReader, chosen: Chosen, pairs: Pairs, camera_frame: str) -> str | None:
    """Returns the frame in which tf knows the motion of both camera and cloud, at least at times; None without one."""
    assert chosen.image is not None
    camera, cloud = camera_frame or chosen.image.frame, frame_of(chosen.partner)
    if cloud is None:
        return None
    for number in pairs.image[[0, len(pairs.image) // 2, -1]]:
        for links in tf.near(int(chosen.image.topic.log_ns[int(number)])):
            for fixed in FIXED_FRAMES:
                if links.is_below(camera, fixed) and links.is_below(cloud, fixed):
                    return fixed
    return None


@contextmanager
def _naming(topic: Topic) -> Iterator[None]:
    """Puts a topic's name before an error in its message."""
    try:
        yield
    except FIELD_ERRORS as error:
        raise ValueError(f"{topic.name}: {error}") from error


def _content(topic: Topic, number: int) -> Any:
    with _naming(topic):
        return message(topic, number)


def _are_equal(a: Camera, b: Camera) -> bool:
    same_size = (a.width_px, a.height_px) == (b.width_px, b.height_px)
    return same_size and float(np.abs(a.matrix - b.matrix).max()) < SAME_K_PX
