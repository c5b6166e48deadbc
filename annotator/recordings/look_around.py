"""What rigs can say beside their frames, and virtual cameras around a LiDAR, to label all that it sees.

A *rig* is a set of recordings of one path that differ only in their option `camera`. They share a clock and clouds.

Each virtual camera is a recording of a rig. Their images overlap by `OVERLAP`, so an object at a border is whole in
one of them. The image is rendered from the points; the cloud is the whole scan.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Collection
from dataclasses import dataclass
from math import pi, radians, tan
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.transforms import right_handed_axes
from annotator.recordings.clouds.columns import RawCloud
from annotator.recordings.clouds.virtual_camera import virtual_image
from annotator.recordings.recording import Place, ReaderOptions, Recording
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import ConfigError


class RigCamera(Recording):
    """A recording of one camera of a rig."""

    # the camera's name, and those of all cameras of the rig
    camera: str
    cameras: tuple[str, ...]

    @abstractmethod
    def moment(self, i: int) -> str:
        """Returns the name of the cloud of frame `i`: frames of the rig's cameras with the same one belong together."""

    @abstractmethod
    def T_rig_camera(self, i: int) -> RigidTransform:
        """Returns the pose of frame `i`'s camera in a frame that is the same for all frames of a moment."""


class Scenes(Recording):
    """A recording of one scene of a dataset."""

    # the scene's name, and those of all scenes of the dataset
    scene: str
    scenes: tuple[str, ...]


def choose(
    path: Path, what: str, wanted: str | None, names: Collection[str], usual: str
) -> tuple[str, tuple[str, ...]]:
    """Returns the scene or camera (`what`) that is wanted, else the usual one; and a note on the others if none is."""
    name = wanted or usual
    if name and name not in names:
        raise ConfigError(f"{path}: has no {what} {name}; it has {', '.join(names) or 'none'}")
    if wanted is not None or len(names) < 2:
        return name, ()
    option = what.split()[-1]
    return name, (f"{len(names)} {option}s: {', '.join(names)}; this is {name} (--{option} names another, or all)",)


@dataclass(frozen=True, eq=False)
class Scan:
    """A whole scan of a LiDAR, also where no camera looks.

    Attributes:
        read: reads the points, in the scan's own frame.
        R_level_scan: turns the scan's frame to x ahead, y left, z against gravity.
        place_m: the place in the scan's frame from which virtual cameras look.
        T_scan_label: from the frame of the recording's label files, as `Frame.T_camera_label`.
        knows_up: False if gravity is unknown, so that the scan's own axes are used.
        timestamp_ns: None if unknown.
        T_world_scan: pose of the scan's frame, as `Frame.T_world_camera`.
        in_map: as `Frame.in_map`.
    """

    read: Callable[[], RawCloud]
    R_level_scan: Rotation
    place_m: Float64[np.ndarray, "3"]
    T_scan_label: RigidTransform
    knows_up: bool = True
    timestamp_ns: int | None = None
    T_world_scan: RigidTransform | None = None
    in_map: bool = False

    def T_camera_scan(self, R_camera_level: Rotation) -> RigidTransform:
        """The transform to a virtual camera at the scan's place."""
        turn = RigidTransform.from_rotation(R_camera_level * self.R_level_scan)
        return turn * RigidTransform.from_translation(-self.place_m)

    def T_world_camera(self, R_camera_level: Rotation) -> RigidTransform | None:
        """The pose of that camera; None if it is not known."""
        return None if self.T_world_scan is None else self.T_world_scan * self.T_camera_scan(R_camera_level).inv()


class Scanned(Recording):
    """A recording of a LiDAR."""

    @abstractmethod
    def scan(self, i: int) -> Scan:
        """Returns the scan of frame `i`, whose points are read where they are needed."""


def level_turn(up: Float64[np.ndarray, "3"], ahead: Float64[np.ndarray, "3"]) -> Rotation:
    """Returns the turn to x ahead (made horizontal), y left, z up; `up` is a unit vector, `ahead` another direction."""
    z, x, y = right_handed_axes(up, ahead).T
    return Rotation.from_matrix(np.stack([x, y, z]))


WIDTH_PX = 1280
OVERLAP = radians(20)
VERTICAL_VIEW = radians(60)
# Rows: the camera's x (right), y (down) and z (forward) in level axes: x ahead, y left, z up.
R_CAMERA_LEVEL = Rotation.from_matrix(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]))
AHEAD = "around-000"


@dataclass(frozen=True, eq=False)
class LookAround(Scanned, RigCamera):
    """A `Recording` of one virtual camera at the LiDAR of another recording.

    `camera` is its name: `around-060` looks 60 degrees to the left of ahead. `others` is a note on the other cameras;
    none if this one was chosen.
    """

    base: Scanned
    cameras: tuple[str, ...]
    camera: str
    others: tuple[str, ...] = ()
    format: ClassVar[str] = "look_around"

    @property
    def is_sequence(self) -> bool:  # type: ignore[override]
        return self.base.is_sequence

    @property
    def root(self) -> Path:
        return self.base.root

    @property
    def name(self) -> str:
        return f"{self.base.name.partition('@')[0]}@{self.camera}"

    @property
    def notes(self) -> tuple[str, ...]:
        return (*self.base.notes, *self.others)

    @property
    def origin(self) -> Place | None:
        return self.base.origin

    @property
    def pose_source(self) -> str | None:
        return self.base.pose_source

    def pose(self, i: int) -> RigidTransform | None:
        return self.base.scan(i).T_world_camera(self._R_camera_level())

    def files(self, i: int) -> tuple[Path, ...]:
        return self.base.files(i)

    def moment(self, i: int) -> str:
        """Returns the frame's key, which all cameras share."""
        return self.key(i)

    def T_rig_camera(self, i: int) -> RigidTransform:
        """Returns the camera's pose in level axes at the LiDAR."""
        self.key(i)
        return RigidTransform.from_rotation(self._R_camera_level().inv())

    def scan(self, i: int) -> Scan:
        return self.base.scan(i)

    def frame(self, i: int) -> Frame:
        return virtual_frame(
            self.base.scan(i), self.key(i), i, virtual_camera(len(self.cameras)), self._R_camera_level()
        )

    def _R_camera_level(self) -> Rotation:
        yaw = 2 * pi * self.cameras.index(self.camera) / len(self.cameras)
        return R_CAMERA_LEVEL * Rotation.from_rotvec([0.0, 0.0, -yaw])


def look_around(base: Scanned, options: ReaderOptions) -> LookAround:
    """Returns a virtual camera of a recording; without the option `camera`, the one that looks ahead."""
    assert options.look_around is not None
    names = camera_names(options.look_around)
    return LookAround(
        base.path, base.keys, base, names, *choose(base.path, "virtual camera", options.camera, names, AHEAD)
    )


def camera_names(count: int) -> tuple[str, ...]:
    """Returns the names of the virtual cameras, by the direction in degrees, ahead first and then to the left."""
    return tuple(f"around-{360 * number // count:03}" for number in range(count))


def virtual_camera(count: int) -> Camera:
    focal_px = WIDTH_PX / 2 / tan(pi / count + OVERLAP / 2)
    height_px = round(2 * focal_px * tan(VERTICAL_VIEW / 2))
    return Camera(WIDTH_PX, height_px, focal_px, focal_px, (WIDTH_PX - 1) / 2, (height_px - 1) / 2)


def virtual_frame(scan: Scan, key: str, index: int, camera: Camera, R_camera_level: Rotation) -> Frame:
    """Returns a scan as seen by a virtual camera at its place; the cloud is the whole scan."""
    T_camera_scan, raw = scan.T_camera_scan(R_camera_level), scan.read()
    cloud = PointCloud(T_camera_scan.apply(raw.xyz_m).astype(np.float32), rgb=raw.rgb, reflectance=raw.reflectance)
    return Frame(
        key,
        index,
        camera,
        virtual_image(camera, cloud),
        cloud,
        up=R_camera_level.apply([0.0, 0.0, 1.0]) if scan.knows_up else None,
        T_camera_label=T_camera_scan * scan.T_scan_label,
        timestamp_ns=scan.timestamp_ns,
        T_world_camera=scan.T_world_camera(R_camera_level),
        in_map=scan.in_map,
    )
