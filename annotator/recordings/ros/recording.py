"""Bags as recordings: an image topic with a cloud or depth topic, or a topic of clouds alone.

Frames are pairs of messages; their keys are the numbers of the images on their topic (without images, of the clouds).
A frame's cloud holds the points that its camera sees, in the camera's frame, by the tf messages of the bag. Where tf
knows how the rig moves (`odom`, `map` or `world`), a cloud is moved from its own time to that of the image, unless the
option `no_motion` is given.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.projection import pixel_colors, unproject_depth
from annotator.geometry.transforms import FORWARD
from annotator.recordings.clouds.cloud_folder import T_CAMERA_LIDAR, VIRTUAL_CAMERA
from annotator.recordings.clouds.columns import FIRST, CommonScale, RawCloud
from annotator.recordings.clouds.virtual_camera import Origin, without_strays, world_pose
from annotator.recordings.kitti import visible_cloud
from annotator.recordings.look_around import Scan, Scanned, level_turn, virtual_frame
from annotator.recordings.recording import Place, ReaderOptions, Recording, option_flag
from annotator.recordings.ros.bag import Bag, Topic, open_bag
from annotator.recordings.ros.messages import FIELD_ERRORS, RECTIFIED, BagCamera, cloud_of, message, read_camera_info
from annotator.recordings.ros.pairing import Pairs, pair, stamps_ns
from annotator.recordings.ros.pictures import color_image, depth_image, video_image
from annotator.recordings.ros.topics import (
    IMU_TYPE,
    VIDEO_TYPE,
    Chosen,
    ImageTopic,
    choose,
    depth_unit_m,
    first_of_pair,
    frame_of,
)
from annotator.recordings.ros.transforms import LinkMissingError, Links, TransformReader, frame_in, up_near
from annotator.recordings.ros.world import BagWorld, find_world, frame_above
from annotator.recordings.two_cameras import registered
from annotator.types import Frame, PointCloud
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
        camera_frame: tf frame of the camera; "" = that of its images.
        fixed_frame: tf frame by which clouds are moved; None if tf does not know how the rig moves.
        world: what says where the rig is; None without tf to a world and topics of poses.
        unit_m: metres of a unit of depth, as RealSense's own topics say; None for other bags.
        scale: of the clouds' reflectance and colours.
        given_origin: the option `origin`, for clouds without images.
    """

    bag: Bag
    chosen: Chosen
    pairs: Pairs
    tf: TransformReader
    camera_frame: str
    fixed_frame: str | None
    world: BagWorld | None
    unit_m: float | None
    told: tuple[str, ...]
    scale: CommonScale = field(default_factory=CommonScale)
    given_origin: Place | None = None
    format: ClassVar[str] = "ros_bag"
    is_sequence: ClassVar[bool] = True

    @property
    def notes(self) -> tuple[str, ...]:
        return (*self.told, *self._origin.notes)

    @property
    def times_ns(self) -> tuple[int, ...]:
        return tuple(self.pairs.time_ns.tolist())

    @property
    def origin(self) -> Place | None:
        is_map = self.chosen.image is None and self._origin.xyz_m.any()
        return tuple(self._origin.xyz_m.tolist()) if is_map else None

    @cached_property
    def _origin(self) -> Origin:
        return Origin(self.given_origin, lambda: (partial(self._raw, i) for i in range(len(self))))

    def _raw(self, i: int) -> RawCloud:
        return self._cloud(self._partner(i))

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

    def frame(self, i: int) -> Frame:
        """Reads frame `i`; from depth images, with `depth_m`."""
        assert self.chosen.image is not None
        with self._errors(i) as key:
            partner, depth_m, in_map = self._partner(i), None, False
            camera, T, up = self._mounted(i, frame_in(self.chosen.partner, partner))
            world = self._T_world_camera(i, camera, T)
            rgb = self._picture(self.chosen.image.topic, int(self.pairs.image[i]), camera)
            if self.chosen.depth is not None:
                cloud, depth_m = self._from_depth(partner, self.chosen.depth, T, rgb, camera, self._log_ns(i))
            else:
                raw, in_map = self._cloud(partner), world_pose(T) is not None
                xyz_m = T.apply(raw.xyz_m).astype(np.float32)
                cloud = visible_cloud(self.path, camera.camera, xyz_m, raw, rgb, f"check tf at frame {key}")
            if len(cloud) == 0:
                raise ValueError(f"no point of {self.chosen.partner.name} lies in the image, so the cloud is empty")
            time_ns = int(self.pairs.time_ns[i])
            return Frame(
                key, i, camera.camera, rgb, cloud, depth_m, up, None, time_ns, T_world_camera=world, in_map=in_map
            )

    @property
    def pose_source(self) -> str | None:
        return None if self.world is None else self.world.source

    def pose(self, i: int) -> RigidTransform | None:
        with self._errors(i):
            camera, T = self._placed(i, frame_of(self.chosen.partner))
            return self._T_world_camera(i, camera, T)

    def _T_world_camera(self, i: int, camera: BagCamera, T_camera_points: RigidTransform) -> RigidTransform | None:
        """Returns the pose of a frame's camera: in the clouds' coordinates if these are a map's, else in the world."""
        if self.chosen.points is not None and (T_map := world_pose(T_camera_points)) is not None:
            return T_map
        T = None
        if self.world is not None:
            T = self.world.T_world(self._camera_frame, int(self.pairs.time_ns[i]), self._log_ns(i))
        return None if T is None else T * camera.T_camera_frame.inv()

    @property
    def _camera_frame(self) -> str:
        assert self.chosen.image is not None
        return self.camera_frame or self.chosen.image.frame

    def _log_ns(self, i: int) -> int:
        topic = self.chosen.partner if self.chosen.image is None else self.chosen.image.topic
        return int(topic.log_ns[int(self.pairs.image[i])])

    def _partner(self, i: int) -> Any:
        with _naming(self.chosen.partner):
            return message(self.chosen.partner, int(self.pairs.cloud[i]))

    def _picture(self, topic: Topic, number: int, camera: BagCamera) -> UInt8[np.ndarray, "h w 3"]:
        with _naming(topic):
            content = message(topic, number)
            if topic.type == VIDEO_TYPE:
                return camera.picture(video_image(topic, number, content))
            return camera.picture(color_image(content, (topic, tuple(self.pairs.image[:FIRST].tolist()))))

    def _cloud(self, content: Any) -> RawCloud:
        """Returns the cloud of a message, with the scale of reflectance that the first ones have."""
        topic, first = self.chosen.partner, self.pairs.cloud
        with _naming(topic):
            raw = cloud_of(content)
        return self.scale.apply(topic, raw, lambda: map(int, first), lambda number: cloud_of(message(topic, number)))

    def _camera(self, info: Topic | None, image: ImageTopic, log_ns: int) -> BagCamera:
        """Returns a camera as its calibration says that was logged nearest to a time."""
        assert info is not None
        is_rectified = bool(RECTIFIED.search(image.base))
        first = first_of_pair(self.bag, info) if is_rectified else None
        with _naming(info):
            content = message(info, info.nearest(log_ns))
            return read_camera_info(content, is_rectified, first and message(first, first.nearest(log_ns)))

    def _from_depth(
        self, content: Any, depth: ImageTopic, T: RigidTransform, rgb: np.ndarray, camera: BagCamera, log_ns: int
    ) -> tuple[PointCloud, Float32[np.ndarray, "h w"]]:
        """Returns the cloud of a depth image, from whose tf frame `T` leads to the camera, and depth in the image."""
        source = self._camera(self.chosen.depth_info, depth, log_ns)
        with _naming(depth.topic):
            depth_m = depth_image(content, self.unit_m)
            if source.fisheye is not None:
                raise ValueError("depth of a fisheye camera is not supported")
            source.require_size(depth_m.shape)
        T_color_depth, (a, b) = T * source.T_camera_frame.inv(), (source.camera, camera.camera)
        is_same = (a.width_px, a.height_px) == (b.width_px, b.height_px) and np.allclose(
            a.matrix, b.matrix, 0, SAME_K_PX
        )
        if is_same and np.allclose(T_color_depth.as_matrix(), np.eye(4)):
            xyz_m, pixel = unproject_depth(b, depth_m)
            return PointCloud(xyz_m, rgb=pixel_colors(rgb, pixel), pixel_index=pixel), depth_m
        return registered(depth_m, a, T_color_depth, rgb, b)

    def _mounted(self, i: int, cloud: str) -> tuple[BagCamera, RigidTransform, Float64[np.ndarray, "3"] | None]:
        """Returns the camera of a frame, the transform to it from the points or depths, and up in it if it is known."""
        camera, T = self._placed(i, cloud)
        return camera, T, self._up(camera, self._camera_frame, int(self.pairs.time_ns[i]), self._log_ns(i))

    def _placed(self, i: int, cloud: str) -> tuple[BagCamera, RigidTransform]:
        """Returns the camera of a frame, and the transform to it from the tf frame `cloud` of the points or depths.

        The points are those at their own time, the camera is that at the time of the image.
        """
        assert self.chosen.image is not None
        log_ns, time_ns, cloud_ns = self._log_ns(i), int(self.pairs.time_ns[i]), int(self.pairs.cloud_time_ns[i])
        camera = self._camera(self.chosen.info, self.chosen.image, log_ns)
        frame, T, via = self._camera_frame, None, self.fixed_frame
        # where the motion is not known, the rigid mount must do
        with suppress(LinkMissingError):
            if via is not None and time_ns != cloud_ns:
                T = self.tf.look_up(
                    log_ns, lambda links: links.transform(frame, via, time_ns) * links.transform(via, cloud, cloud_ns)
                )
        if T is None:
            T = self.tf.look_up(log_ns, partial(_link, frame, cloud, time_ns))
        return camera, camera.T_camera_frame * T

    def _up(self, camera: BagCamera, camera_frame: str, time_ns: int, log_ns: int) -> Float64[np.ndarray, "3"] | None:
        """Returns the unit vector against gravity by an IMU at rest, of which tf knows how it is turned."""
        for topic in self.bag.of_type(IMU_TYPE):
            up, frame = up_near(topic, log_ns)
            if up is not None:
                with suppress(LinkMissingError):
                    T = self.tf.look_up(log_ns, partial(_link, camera_frame, frame, time_ns), 2)
                    return np.asarray((camera.T_camera_frame.rotation * T.rotation).apply(up))
        return None


@dataclass(frozen=True, eq=False)
class ScanBag(RosBag, Scanned):
    """A bag of clouds, with images or without."""

    def frame(self, i: int) -> Frame:
        if self.chosen.image is not None:
            return super().frame(i)
        with self._errors(i) as key:
            return virtual_frame(self.scan(i), key, i, VIRTUAL_CAMERA, T_CAMERA_LIDAR.rotation)

    def scan(self, i: int) -> Scan:
        """Returns the whole cloud of frame `i`, ahead being where the camera looks, or x without images.

        Without an IMU, z is taken as up.
        """
        with self._errors(i):
            content = self._partner(i)
            raw, frame = self._cloud(content), frame_in(self.chosen.partner, content)
            R_level_scan, knows_up = Rotation.identity(), True
            if self.chosen.image is None:
                place_m = self._origin.of(raw)
                raw = without_strays(raw, place_m)
                T_world_scan = RigidTransform.identity() if place_m.any() else self._T_world_scan(i, frame)
            else:
                camera, T_camera_scan, up = self._mounted(i, frame)
                R_scan_camera, knows_up = T_camera_scan.rotation.inv(), up is not None
                up_scan = Z if up is None else R_scan_camera.apply(up)
                R_level_scan = level_turn(up_scan, R_scan_camera.apply(FORWARD))
                T_map_camera = world_pose(T_camera_scan)
                place_m = np.zeros(3) if T_map_camera is None else T_map_camera.translation
                T_world_camera = self._T_world_camera(i, camera, T_camera_scan)
                T_world_scan = None if T_world_camera is None else T_world_camera * T_camera_scan
            time_ns = int(self.pairs.cloud_time_ns[i])
            T_scan_label = RigidTransform.identity()
            in_map = bool(place_m.any())
            return Scan(lambda: raw, R_level_scan, place_m, T_scan_label, knows_up, time_ns, T_world_scan, in_map)

    def pose(self, i: int) -> RigidTransform | None:
        if self.chosen.image is not None:
            return super().pose(i)
        if self.world is not None and self.given_origin is None and not self._origin.xyz_m.any():
            T_world_scan = self._T_world_scan(i, frame_of(self.chosen.partner))
            return None if T_world_scan is None else T_world_scan * T_CAMERA_LIDAR.inv()
        return self.scan(i).T_world_camera(T_CAMERA_LIDAR.rotation)

    def _T_world_scan(self, i: int, frame: str) -> RigidTransform | None:
        time_ns, log_ns = int(self.pairs.cloud_time_ns[i]), self._log_ns(i)
        return None if self.world is None else self.world.T_world(frame, time_ns, log_ns)


def open_ros_bag(path: Path, options: ReaderOptions) -> RosBag | None:
    """Opens the bag at `path`, without reading images or clouds; None if it is not one."""
    bag = open_bag(path)
    if bag is None:
        return None
    chosen, tf, camera_frame = choose(bag, options), TransformReader.of(bag), (options.tf_frame or "").lstrip("/")
    unit_m, notes, fixed = depth_unit_m(bag, chosen), list(bag.notes), None
    if chosen.image is None:
        pairs = _alone(chosen.partner)
        notes.append("has no images: a virtual camera looks forward from the LiDAR, which must be level")
    elif options.origin is not None:
        raise ConfigError(
            f"{path}: the images of {chosen.image.topic.name} say where the camera is, so {option_flag('origin')} "
            "is not taken; it is for bags without images"
        )
    else:
        # RealSense's cameras are not synchronised
        period_s = 1 / (chosen.partner.rate_hz or np.inf) if unit_m is not None else 0.0
        pairs = pair(chosen.image.topic, chosen.partner, options.tolerance_s or max(TOLERANCE_S, period_s))
        notes += pairs.notes
        if not options.no_motion and len(pairs.image):
            moving = camera_frame or chosen.image.frame, frame_of(chosen.partner)
            fixed = frame_above(tf, moving, _log_times(chosen.image.topic, pairs), FIXED_FRAMES)
    if not len(pairs.image):
        raise RecordingError(f"{path}: no frames; {'; '.join(pairs.notes)}")
    if fixed is not None:
        notes.append(
            f"clouds are moved to the images' times by the motion of the rig in {fixed} where tf knows it "
            "(not with --no-motion)"
        )
    sensor, topic = frame_of(chosen.partner), chosen.partner
    if chosen.image is not None:
        sensor, topic = camera_frame or chosen.image.frame, chosen.image.topic
    world, told = find_world(bag, tf, sensor, _log_times(topic, pairs))
    notes += [told] if told else []
    keys = tuple(f"{number:06d}" for number in pairs.image)
    kind = RosBag if chosen.points is None else ScanBag
    return kind(
        path,
        keys,
        bag,
        chosen,
        pairs,
        tf,
        camera_frame,
        fixed,
        world,
        unit_m,
        tuple(notes),
        given_origin=options.origin,
    )


def _alone(clouds: Topic) -> Pairs:
    stamps = stamps_ns(clouds)
    times = stamps if (stamps > 0).all() else clouds.log_ns
    order = np.argsort(times, kind="stable")
    return Pairs(order, order, times[order], times[order], ())


def _log_times(topic: Topic, pairs: Pairs) -> list[int]:
    return [int(topic.log_ns[number]) for number in pairs.image.tolist()]


def _link(target: str, source: str, time_ns: int, links: Links) -> RigidTransform:
    return links.transform(target, source, time_ns)


@contextmanager
def _naming(topic: Topic) -> Iterator[None]:
    try:
        yield
    except FIELD_ERRORS as error:
        raise ValueError(f"{topic.name}: {error}") from error
