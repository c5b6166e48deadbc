"""The shown points of a cloud, their size and colours, and the initial camera of a viewport."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8

from annotator.geometry.projection import thin
from annotator.types import Frame, PointCloud
from annotator.web.viewport.content import InitialCamera, PointColor

# Depth and height colours cover the range between these percentiles, so that outliers do not compress them.
LOW_PERCENT, HIGH_PERCENT = 2.0, 98.0
# Point size as a share of the cloud's median distance: about the spacing of a thinned RGB-D cloud.
POINT_SHARE = 0.0035
# If there are fewer points than FULL_DETAIL, they are drawn larger, up to a factor. The factor is higher for a thinned
# cloud, whose surfaces are dense.
FULL_DETAIL, LARGEST_GROWTH, LARGEST_GROWTH_THINNED = 150_000, 2.0, 3.5
# Number of points for estimates of a scene's distance.
SAMPLE = 5_000
# Position of the initial camera behind and above the recording's camera, as shares of the scene's distance.
BEHIND, ABOVE = 0.2, 0.2
# Distance of an empty scene, metres.
EMPTY_DISTANCE_M = 3.0

CAMERA_UP = np.array([0.0, -1.0, 0.0])


def shown_points(frame: Frame, most: int) -> PointCloud:
    """The shown part of a frame's cloud, at most `most` points, with colours and reflectance."""
    cloud = frame.cloud
    keep = thin(len(cloud), most)
    if keep is None:
        return cloud
    rgb, reflectance = (
        None if values is None else values.take(keep, axis=0) for values in (cloud.rgb, cloud.reflectance)
    )
    return PointCloud(cloud.xyz_m.take(keep, axis=0), rgb, reflectance)


def point_colors(cloud: PointCloud, color: PointColor, up: Float64[np.ndarray, "3"]) -> UInt8[np.ndarray, "n 3"]:
    """The colour of each point; a cloud without the required quantity is coloured by depth.

    Args:
        up: unit vector, camera frame.
    """
    if color is PointColor.RGB and cloud.rgb is not None:
        return cloud.rgb
    if color is PointColor.HEIGHT:
        return _mapped(cloud.xyz_m @ up.astype(np.float32))
    if color is not PointColor.DEPTH and cloud.reflectance is not None:
        # the square root brightens dark values, which most LiDAR returns have
        return _gray(np.sqrt(np.clip(cloud.reflectance, 0, 1)))
    if color is PointColor.INTENSITY and cloud.rgb is not None:
        return _gray(cloud.rgb @ np.array([0.299, 0.587, 0.114], np.float32) / np.float32(255))
    return _mapped(-np.log(np.maximum(cloud.xyz_m[:, 2], np.float32(0.05))))


def typical_distance_m(cloud: PointCloud) -> float:
    """Median distance of the points from the camera, metres."""
    if len(cloud) == 0:
        return EMPTY_DISTANCE_M
    some = cloud.xyz_m[:: max(1, len(cloud) // SAMPLE)]
    return max(float(np.median(np.linalg.norm(some, axis=1))), 0.05)


def point_size_m(shown: PointCloud, n_points: int) -> float:
    """The default point size, metres.

    Args:
        shown: the shown points; the fewer, the larger each is, so that surfaces stay closed.
        n_points: of the whole cloud.
    """
    ratio = max(FULL_DETAIL / max(len(shown), 1), 1.0)
    largest = LARGEST_GROWTH if n_points == len(shown) else LARGEST_GROWTH_THINNED
    return POINT_SHARE * typical_distance_m(shown) * min(math.sqrt(ratio), largest)


def scene_up(frame: Frame) -> Float64[np.ndarray, "3"]:
    """The up direction in the camera frame: against gravity if known, else up in the image."""
    return CAMERA_UP if frame.up is None else frame.up


def initial_camera(frame: Frame) -> InitialCamera:
    """A pose behind and slightly above the recording's camera, looking along its optical axis."""
    ahead_m = EMPTY_DISTANCE_M
    if len(frame.cloud):
        ahead_m = max(float(np.median(frame.cloud.xyz_m[:: max(1, len(frame.cloud) // SAMPLE), 2])), 0.2)
    up = scene_up(frame)
    axis = np.array([0.0, 0.0, 1.0])
    return InitialCamera(ahead_m * (ABOVE * up - BEHIND * axis), ahead_m * axis, up)


def _gray(share: Float[np.ndarray, "n"]) -> UInt8[np.ndarray, "n 3"]:
    level = (share * 215 + 40).astype(np.uint8)
    return np.repeat(level[:, None], 3, axis=1)


def _mapped(values: Float32[np.ndarray, "n"]) -> UInt8[np.ndarray, "n 3"]:
    """Blue for low values to red for high ones."""
    if len(values) == 0:
        return np.zeros((0, 3), np.uint8)
    low, high = np.percentile(values[:: max(1, len(values) // SAMPLE)], [LOW_PERCENT, HIGH_PERCENT])
    level = np.clip((values - np.float32(low)) * np.float32(255 / max(high - low, 1e-6)), 0, 255).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(level[None], cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)[0]
