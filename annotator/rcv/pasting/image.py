"""The picture of an object that was cut out of a frame (`pasting`), drawn into the image of another frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from annotator.geometry.projection import project
from annotator.geometry.sight_grid import GAP
from annotator.rcv.pasting.objects import Cutout, PastedFrame
from annotator.types import Camera, Frame

# Pixels around a patch, so that its edge can be smoothed.
BORDER_PX = 3
# An object whose points move on the image otherwise than by an affine map, with a larger error than this share of its
# size (root mean square), is not drawn.
MOST_ERROR = 0.08
# LiDAR points are too sparse to tell which pixels of an object are hidden, so this share of the points must be visible.
MOSTLY_VISIBLE = 0.9


@dataclass(frozen=True, eq=False)
class ImagePatch:
    """An object's pixels.

    Attributes:
        camera: of the frame that it was cut out of.
        rgb: (h, w, 3) the part of the image around the object.
        mask: (h, w) the object's pixels: those of its points for a depth camera, else their convex outline.
        first_px: column and row of the patch's first pixel in the image.
        is_dense: whether it was seen by a depth camera.
    """

    camera: Camera
    rgb: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]
    first_px: tuple[int, int]
    is_dense: bool


def image_patch(frame: Frame, cutout: Cutout) -> ImagePatch | None:
    """The pixels of an object that was cut out of `frame`; None if it is not on the image."""
    camera, is_dense = frame.camera, cutout.grid.camera is not None
    mask = _covered(camera, cutout.cloud.xyz_m[cutout.own], is_dense)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        return None
    top, left = max(int(rows[0]) - BORDER_PX, 0), max(int(columns[0]) - BORDER_PX, 0)
    part = np.s_[top : int(rows[-1]) + 1 + BORDER_PX, left : int(columns[-1]) + 1 + BORDER_PX]
    return ImagePatch(camera, frame.rgb[part].copy(), mask[part].copy(), (left, top), is_dense)


def draw_patch(patch: ImagePatch, pasted: PastedFrame) -> UInt8[np.ndarray, "h w 3"] | None:
    """The image of the frame with the object drawn into it.

    The pixels are moved by the affine map that fits the object's points best.

    Returns:
        None if the map does not fit, or if too much of an object that a LiDAR measured is hidden.
    """
    camera, points = pasted.frame.camera, pasted.objects[-1].points
    if points is None or not (patch.is_dense or pasted.visible >= MOSTLY_VISIBLE):
        return None
    moved_m = pasted.frame.cloud.xyz_m[points]
    before, after = project(patch.camera, pasted.source_m) - patch.first_px, project(camera, moved_m)
    known = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    start = np.column_stack([before[known], np.ones(int(known.sum()))])
    moving, _, rank, _ = np.linalg.lstsq(start, after[known], rcond=None)
    size_px = float(np.ptp(after[known], axis=0).max())
    error_px = float(np.sqrt(((start @ moving - after[known]) ** 2).sum(axis=1).mean()))
    if rank < 3 or error_px > MOST_ERROR * size_px:
        return None
    height, width = pasted.frame.rgb.shape[:2]
    drawn = cv2.warpAffine(patch.rgb, moving.T, (width, height), flags=cv2.INTER_LINEAR)
    share = cv2.warpAffine(patch.mask.astype(np.float32), moving.T, (width, height), flags=cv2.INTER_LINEAR)
    if patch.is_dense:
        share *= _covered(camera, moved_m, True)
    share = cv2.blur(share, (3, 3))[:, :, None]
    return np.rint(pasted.frame.rgb * (1 - share) + drawn * share).astype(np.uint8)


def _covered(camera: Camera, xyz_m: Float[np.ndarray, "n 3"], is_dense: bool) -> Bool[np.ndarray, "h w"]:
    """The pixels of points: with small gaps closed if they are dense, else those within their convex outline."""
    px = project(camera, xyz_m)
    px = np.rint(px[np.isfinite(px).all(axis=1) & (np.abs(px) < 1e5).all(axis=1)]).astype(np.int32)
    mask = np.zeros((camera.height_px, camera.width_px), np.uint8)
    if len(px) == 0:
        return mask.astype(bool)
    if not is_dense:
        cv2.fillConvexPoly(mask, cv2.convexHull(px), 1)
        return mask.astype(bool)
    px = px[((px >= 0) & (px < [camera.width_px, camera.height_px])).all(axis=1)]
    mask[px[:, 1], px[:, 0]] = 1
    kernel = np.ones((GAP + 1, GAP + 1), np.uint8)
    return np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel).astype(bool))
