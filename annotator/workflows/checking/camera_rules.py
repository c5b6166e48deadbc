"""Rules about one frame's camera, and about whether its cloud fits the camera."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from annotator.geometry.projection import project
from annotator.recordings.plausible import DISTANCES_M
from annotator.types import Camera, Frame
from annotator.workflows.checking.rules import (
    CAMERA_OF_OTHER_SIZE,
    CLOUD_OFF_DEPTH,
    CLOUD_OFF_IMAGE,
    CLOUD_SCALE,
    IMAGE_BARE,
    IMPOSSIBLE_CAMERA,
    Rule,
)

# Focal length in image widths: fields of view from 150 to 2 degrees.
FOCAL_LENGTHS = (0.13, 30.0)
# Ratio of the focal lengths: pixels are square, or binned in one direction.
MOST_ASPECT = 2.0
# Range of the principal point as a fraction of the image size; cropped images have it far from the middle.
PRINCIPAL_POINT = (0.2, 0.8)
SAMPLE = 5000
MOST_OFF_PIXEL_PX = 1.0
# Nearly all points of a depth camera are on its image, except at the border.
LEAST_ON_IMAGE, BORDER_PX = 0.9, 3.0
CELL_PX = 16
LEAST_COVERED = 0.02

Breach = tuple[Rule, str]


def camera_rules(camera: Camera) -> Iterator[Breach]:
    """Yields what is implausible about a camera for its image size."""
    size = f"for images of {camera.width_px} x {camera.height_px} px"
    shares = camera.fx / camera.width_px, camera.fy / camera.width_px
    low, high = FOCAL_LENGTHS
    aspect = max(shares) / min(shares)
    if min(shares) < low or max(shares) > high or aspect > MOST_ASPECT:
        yield IMPOSSIBLE_CAMERA, f"focal lengths {camera.fx:g} and {camera.fy:g} px {size}"
    middle = np.array([camera.cx / camera.width_px, camera.cy / camera.height_px])
    if (middle < PRINCIPAL_POINT[0]).any() or (middle > PRINCIPAL_POINT[1]).any():
        yield (
            CAMERA_OF_OTHER_SIZE,
            f"the principal point is ({camera.cx:g}, {camera.cy:g}) {size}; is it the camera of another image size?",
        )


def cloud_rules(frame: Frame, *, of_depth_camera: bool) -> Iterator[Breach]:
    """Yields what is implausible about a frame's cloud.

    Args:
        of_depth_camera: all points come from pixels of the image.
    """
    xyz_m = frame.cloud.xyz_m
    distance_m = float(np.median(np.linalg.norm(xyz_m, axis=1)))
    if not DISTANCES_M[0] <= distance_m <= DISTANCES_M[1]:
        yield CLOUD_SCALE, f"half of the points are nearer than {distance_m:g} m; are they in metres?"
    chosen = np.linspace(0, len(xyz_m) - 1, min(len(xyz_m), SAMPLE)).astype(np.int64)
    px = project(frame.camera, xyz_m[chosen])
    if frame.cloud.pixel_index is not None:
        v, u = np.divmod(frame.cloud.pixel_index[chosen], frame.camera.width_px)
        off = np.linalg.norm(px - np.stack([u, v], axis=1), axis=1)
        typical = float(np.median(np.nan_to_num(off, nan=np.inf)))
        if typical > MOST_OFF_PIXEL_PX:
            yield CLOUD_OFF_DEPTH, f"points project {typical:.1f} px away from their own pixels"
    size = np.array([frame.camera.width_px, frame.camera.height_px])
    # points behind the camera are NaN and compare as false
    on_image = ((px >= -BORDER_PX) & (px <= size + BORDER_PX)).all(axis=1)
    if of_depth_camera and on_image.mean() < LEAST_ON_IMAGE:
        yield CLOUD_OFF_IMAGE, f"{1 - on_image.mean():.0%} of the points of this depth camera are outside its image"
    elif frame.depth_m is None:
        cells = np.unique(np.floor(px[on_image] / CELL_PX).clip(0).astype(np.int64), axis=0)
        covered = len(cells) / np.prod(np.ceil(size / CELL_PX))
        if covered < LEAST_COVERED:
            yield IMAGE_BARE, f"the points cover {covered:.1%} of the image; do calibration and cloud belong together?"
