"""One moment of a recording: a camera, its image, and the point cloud that belongs to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.types.checks import as_array

DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of one camera; its axes are OpenCV's: x right, y down, z forward.

    Pixel coordinates are continuous and the centre of the first pixel is (0, 0), so that the image
    covers [-0.5, width_px - 0.5] x [-0.5, height_px - 0.5].

    Attributes:
        fx, fy, cx, cy: focal lengths and principal point, pixels.
        distortion: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]] as in `cv2.projectPoints`;
            empty for an ideal pinhole.
    """

    width_px: int
    height_px: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width_px <= 0 or self.height_px <= 0:
            raise ValueError(f"image size must be positive, not {self.width_px} x {self.height_px}")
        if not (self.fx > 0 and self.fy > 0):
            raise ValueError(f"focal lengths must be positive, not {self.fx}, {self.fy}")
        if len(self.distortion) not in DISTORTION_LENGTHS:
            raise ValueError(
                f"distortion must have one of {DISTORTION_LENGTHS} coefficients, not {len(self.distortion)}"
            )

    @property
    def matrix(self) -> Float64[np.ndarray, "3 3"]:
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_ideal(self) -> bool:
        """True if the camera has no distortion."""
        return not any(self.distortion)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """N points in the camera frame, with the sensor's attributes of each.

    Attributes:
        xyz_m: (N, 3) float32, metres; finite (readers drop invalid points).
        rgb: (N, 3) uint8 colours, or None.
        reflectance: (N,) float32 in 0..1, or None.
        pixel_index: (N,) int32, `v * width + u` of the depth pixel of each point, if the cloud is registered
            to the camera image (RGB-D); None for a LiDAR.
        normals: (N, 3) float32 unit normals towards the sensor, zero if unknown; None until estimated.
    """

    xyz_m: Float32[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"] | None = None
    reflectance: Float32[np.ndarray, "n"] | None = None
    pixel_index: Int32[np.ndarray, "n"] | None = None
    normals: Float32[np.ndarray, "n 3"] | None = None

    def __post_init__(self) -> None:
        xyz = as_array("xyz_m", self.xyz_m, np.float32, (None, 3))
        object.__setattr__(self, "xyz_m", xyz)
        n = len(xyz)
        for name, dtype, shape in (
            ("rgb", np.uint8, (n, 3)),
            ("reflectance", np.float32, (n,)),
            ("pixel_index", np.int32, (n,)),
            ("normals", np.float32, (n, 3)),
        ):
            if (values := getattr(self, name)) is not None:
                object.__setattr__(self, name, as_array(name, values, dtype, shape))

    def __len__(self) -> int:
        return len(self.xyz_m)

    def select(self, keep: np.ndarray) -> PointCloud:
        """The points selected by a boolean mask (N,) or an index array, with all their attributes."""
        # gathering by index is several times as fast as by mask
        index = np.flatnonzero(keep) if keep.dtype == np.bool_ else keep

        def pick(values: np.ndarray | None) -> np.ndarray | None:
            return None if values is None else values.take(index, axis=0)

        return PointCloud(
            self.xyz_m.take(index, axis=0),
            pick(self.rgb),
            pick(self.reflectance),
            pick(self.pixel_index),
            pick(self.normals),
        )


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a recording.

    Attributes:
        key: the frame's name within its recording, such as "000012"; unique and stable.
        index: position within the recording, from 0.
        rgb: (H, W, 3) uint8 image of the colour camera, RGB order.
        cloud: all valid points, in the camera frame.
        depth_m: (H, W) float32 depth registered to the image, metres, 0 = no measurement; None for a LiDAR. If another
            camera measured it, the cloud has no `pixel_index`, and there are gaps between its pixels.
        up: unit vector against gravity in the camera frame; None if unknown.
        T_camera_label: from the frame in which the recording's own label files are written to the camera
            frame (KITTI: rectified camera 0; SUN RGB-D: upright depth); None if they are the same.
        timestamp_ns: capture time; None if unknown.
        T_camera_recorded: from the camera frame as the recording's files give it, to the corrected one; None if the
            project does not correct the calibration.
        T_world_camera: pose of the camera in a world that is the same for all frames: the map coordinates of the
            recording's clouds, else that of its poses (`Recording.pose`); None without such.
        in_map: True if that world is the map of the clouds. Boxes keep their place in it, wherever a virtual camera
            stands. Poses may be corrected, and boxes keep their place before the camera.
        exif_orientation: of the image file if `rgb` has its pixels as stored, not as viewers show them; else 1.
    """

    key: str
    index: int
    camera: Camera
    rgb: UInt8[np.ndarray, "h w 3"]
    cloud: PointCloud
    depth_m: Float32[np.ndarray, "h w"] | None = None
    up: Float64[np.ndarray, "3"] | None = None
    T_camera_label: RigidTransform | None = None
    timestamp_ns: int | None = None
    T_camera_recorded: RigidTransform | None = None
    T_world_camera: RigidTransform | None = None
    exif_orientation: int = 1
    in_map: bool = False

    def __post_init__(self) -> None:
        size = (self.camera.height_px, self.camera.width_px)
        object.__setattr__(self, "rgb", as_array("rgb", self.rgb, np.uint8, (*size, 3)))
        if self.depth_m is not None:
            object.__setattr__(self, "depth_m", as_array("depth_m", self.depth_m, np.float32, size))
        if self.up is not None:
            up = as_array("up", self.up, np.float64, (3,))
            object.__setattr__(self, "up", up / np.linalg.norm(up))


MOST_TURN_RAD, MOST_SHIFT_M, MOST_OFFSET_S = np.pi, 1e4, 3600.0


@dataclass(frozen=True)
class Correction:
    """Moves a recording's clouds relative to its images.

    Attributes:
        turn_rad: rotation vector, about the camera's x, y, z axes; applied first.
        shift_m: translation, along the camera's axes.
        time_offset_s: the clouds' clock minus the images': a frame's cloud is shown with the image that is nearest in
            time to the cloud's time minus this.
    """

    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    time_offset_s: float = 0.0

    def __post_init__(self) -> None:
        for name, values, most in (
            ("turn_rad", self.turn_rad, MOST_TURN_RAD),
            ("shift_m", self.shift_m, MOST_SHIFT_M),
            ("time_offset_s", (self.time_offset_s,), MOST_OFFSET_S),
        ):
            if not all(abs(value) <= most for value in values):
                raise ValueError(f"{name} must be finite and at most {most:g}")

    @property
    def moves(self) -> bool:
        """True if the clouds are turned or shifted."""
        return any(self.turn_rad) or any(self.shift_m)

    @property
    def T_camera_recorded(self) -> RigidTransform:
        """From the camera frame as the recording's files give it to the corrected one."""
        return RigidTransform.from_components(np.array(self.shift_m), Rotation.from_rotvec(np.array(self.turn_rad)))


NO_CORRECTION = Correction()
