"""Normals for the projection axes, estimated once per frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from annotator.geometry.normals import normals_from_depth, normals_knn
from annotator.geometry.projection import in_frustums
from annotator.rcv.config import RcvConfig, Strategy
from annotator.types import Box2D, BoxKind, Frame, PointCloud


def needs_normals(config: RcvConfig) -> bool:
    """True if the recursion uses normals with these settings."""
    return config.strategy is Strategy.NORMALS or (
        config.strategy is Strategy.CONSENSUS and config.box_kind is BoxKind.SILHOUETTE
    )


def with_normals(frame: Frame, mask: Bool[np.ndarray, "n"], config: RcvConfig) -> PointCloud:
    """The frame's cloud with normals, at least at the points of `mask`; zero if unknown.

    They are estimated from pixel neighbours if the cloud comes from a depth image, otherwise from the nearest
    neighbours within `mask`.
    """
    cloud = frame.cloud
    if cloud.normals is not None:
        return cloud
    if frame.depth_m is not None and cloud.pixel_index is not None:
        grid = normals_from_depth(frame.camera, frame.depth_m).reshape(-1, 3)
        return replace(cloud, normals=grid[cloud.pixel_index])
    normals = np.zeros((len(cloud), 3), np.float32)
    if mask.any():
        normals[mask] = normals_knn(cloud.xyz_m[mask], config.axes.normal_neighbours)
    return replace(cloud, normals=normals)


def frame_with_normals(frame: Frame, image_boxes: Sequence[Box2D], config: RcvConfig) -> Frame:
    """The frame with normals in the frustums of all these boxes, so that they are not estimated once per object."""
    if not image_boxes or frame.cloud.normals is not None:
        return frame
    mask = np.logical_or.reduce(in_frustums(frame.camera, frame.cloud.xyz_m, image_boxes))
    return replace(frame, cloud=with_normals(frame, mask, config))
