"""Frames with a corrected calibration: the cloud moved relative to the image, or shown with another image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from annotator.geometry.normals import normals_from_depth
from annotator.geometry.projection import inside_image, project
from annotator.types import Correction, Frame, PointCloud


def corrected(frame: Frame, correction: Correction) -> Frame:
    """The frame with its cloud turned and shifted; what the cloud knows (normals, up, labels of its files) moves along.

    The depth image is no longer registered to the camera, so it is left out; normals are taken from it before.
    """
    if not correction.moves:
        return frame
    T, cloud = correction.T_camera_recorded, frame.cloud
    normals = cloud.normals
    if normals is None and frame.depth_m is not None and cloud.pixel_index is not None:
        normals = normals_from_depth(frame.camera, frame.depth_m).reshape(-1, 3)[cloud.pixel_index]
    moved = PointCloud(
        T.apply(cloud.xyz_m).astype(np.float32),
        cloud.rgb,
        cloud.reflectance,
        normals=None if normals is None else T.rotation.apply(normals).astype(np.float32),
    )
    label = T if frame.T_camera_label is None else T * frame.T_camera_label
    up = None if frame.up is None else np.asarray(T.rotation.apply(frame.up))
    world = None if frame.T_world_camera is None else frame.T_world_camera * T.inv()
    return _coloured(
        replace(
            frame,
            cloud=moved,
            depth_m=None,
            up=up,
            T_camera_label=label,
            T_camera_recorded=T,
            T_world_camera=world,
        )
    )


def with_image(frame: Frame, rgb: UInt8[np.ndarray, "h w 3"]) -> Frame:
    """The frame with another image of the same camera, which colours its cloud."""
    return _coloured(replace(frame, rgb=rgb))


def _coloured(frame: Frame) -> Frame:
    """The frame with the colours of its image on its cloud, if it has colours; points off the image keep theirs."""
    cloud = frame.cloud
    if cloud.rgb is None:
        return frame
    px = project(frame.camera, cloud.xyz_m)
    seen = np.flatnonzero(inside_image(frame.camera, px))
    u, v = np.round(px[seen]).astype(np.int64).T
    colours = cloud.rgb.copy()
    colours[seen] = frame.rgb[v, u]
    return replace(frame, cloud=replace(cloud, rgb=colours))
