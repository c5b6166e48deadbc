"""Which points of a cloud are shown, how large and in which colours, and from where one looks at them first."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8

from annotator.geometry.thinning import thin
from annotator.types import Frame, PointCloud
from annotator.web.viewport.content import FirstView, PointColor

# Depth and height colours run over what lies between these percentiles, so that a far outlier does not flatten them.
LOW_PERCENT, HIGH_PERCENT = 2.0, 98.0
# A point's size as a share of the cloud's median distance: about the spacing of an RGB-D camera's points, thinned.
POINT_SHARE = 0.0035
# Below so many points they are drawn larger, up to so much; more where a dense cloud is thinned, which has no gaps.
FULL_DETAIL, LARGEST_GROWTH, LARGEST_GROWTH_THINNED = 150_000, 2.0, 3.5
# Enough points to know how far away a scene is.
SAMPLE = 5_000
# The first view stands behind the camera and above it, as shares of the scene's distance.
BEHIND, ABOVE = 0.2, 0.2
# Where there is nothing to look at, metres.
EMPTY_DISTANCE_M = 3.0

CAMERA_UP = np.array([0.0, -1.0, 0.0])


def shown_points(frame: Frame, most: int) -> PointCloud:
    """The part of a frame's cloud that is shown, with what it can be coloured by."""
    cloud = frame.cloud
    keep = thin(len(cloud), most)
    if keep is None:
        return cloud
    rgb, reflectance = (
        None if values is None else values.take(keep, axis=0) for values in (cloud.rgb, cloud.reflectance)
    )
    return PointCloud(cloud.xyz_m.take(keep, axis=0), rgb, reflectance)


def point_colors(cloud: PointCloud, color: PointColor, up: Float64[np.ndarray, "3"]) -> UInt8[np.ndarray, "n 3"]:
    """A colour for each point; a cloud that lacks what the colours stand for is coloured by depth.

    Args:
        up: unit vector, camera frame.
    """
    if color is PointColor.RGB and cloud.rgb is not None:
        return cloud.rgb
    if color is PointColor.HEIGHT:
        return _mapped(cloud.xyz_m @ up.astype(np.float32))
    if color is not PointColor.DEPTH and cloud.reflectance is not None:
        # The square root lifts the dark end, where most LiDAR returns lie.
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
    """How large a point is drawn that nobody has changed the size of, metres.

    Args:
        shown: the points that are drawn; where they are fewer, each is larger, so that surfaces stay closed.
        n_points: of the whole cloud.
    """
    fewer = max(FULL_DETAIL / max(len(shown), 1), 1.0)
    largest = LARGEST_GROWTH if n_points == len(shown) else LARGEST_GROWTH_THINNED
    return POINT_SHARE * typical_distance_m(shown) * min(math.sqrt(fewer), largest)


def scene_up(frame: Frame) -> Float64[np.ndarray, "3"]:
    """Up in the camera frame: against gravity where it is known, else up in the image."""
    return CAMERA_UP if frame.up is None else frame.up


def first_view(frame: Frame) -> FirstView:
    """From behind the camera and a little above it, along the optical axis."""
    ahead_m = EMPTY_DISTANCE_M
    if len(frame.cloud):
        ahead_m = max(float(np.median(frame.cloud.xyz_m[:: max(1, len(frame.cloud) // SAMPLE), 2])), 0.2)
    up = scene_up(frame)
    axis = np.array([0.0, 0.0, 1.0])
    return FirstView(ahead_m * (ABOVE * up - BEHIND * axis), ahead_m * axis, up)


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
