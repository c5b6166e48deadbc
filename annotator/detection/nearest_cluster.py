"""A pseudo-view detector that needs no training: it returns the box around the nearest cluster of points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from annotator.types import Box2D, BoxKind, Image, PseudoView
from annotator.types.errors import DetectionError


class NearestCluster:
    """Detects the cluster of points nearest to the camera, on every pseudo-view of a frustum.

    This works for objects with free space around them, such as a hand in the air or a box on a pole. If the
    object touches the floor, a table or another object, the cluster includes that as well. Such objects need a trained
    view detector.
    """

    box_kind = BoxKind.SILHOUETTE

    def __init__(self, *labels: str, gap_m: float = 0.05, min_share: float = 0.1) -> None:
        """
        Args:
            labels: class names; each pseudo-view gets one box per class.
            gap_m: points closer to each other than about this belong to one cluster, metres. It should be larger than
                the spacing of points, and smaller than the distance between the object and its background.
            min_share: clusters with a smaller share of the points are ignored as noise.

        Raises:
            ValueError: no labels, a gap of 0 or less, or a share outside 0..1.
        """
        if not labels or not gap_m > 0 or not 0 <= min_share <= 1:
            raise ValueError(f"needs a label, gap_m > 0 and min_share in 0..1, not {labels}, {gap_m} and {min_share}")
        self._labels, self._gap_m, self._min_share = labels, gap_m, min_share

    @property
    def labels(self) -> tuple[str, ...]:
        """The class names."""
        return self._labels

    @property
    def fingerprint(self) -> str:
        """The settings as text."""
        return f"nearest-cluster-1 {self._labels} {self._gap_m} {self._min_share}"

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        """One box per class on each pseudo-view; no box on a view without points.

        Raises:
            DetectionError: an image is not a pseudo-view, so it has no points.
        """
        # the views of one step share their points
        groups: dict[int, Float32[np.ndarray, "k 3"]] = {}
        boxes_per_view = []
        for view in images:
            if not isinstance(view, PseudoView):
                raise DetectionError(f"NearestCluster takes pseudo-views only, not {type(view).__name__}")
            if id(view.xyz_m) not in groups:
                groups[id(view.xyz_m)] = view.xyz_m[self._nearest(view.xyz_m)]
            boxes_per_view.append(self._boxes(view, groups[id(view.xyz_m)]))
        return boxes_per_view

    def _boxes(self, view: PseudoView, xyz_m: Float32[np.ndarray, "k 3"]) -> list[Box2D]:
        if not len(xyz_m):
            return []
        xy = xyz_m @ view.axes[:2].T
        span = np.stack([xy.min(axis=0), xy.max(axis=0)], axis=1)
        # points are treated as one pixel wide, so that a flat cluster has a valid box
        half = view.metres_per_px / 2
        return [view.box_px(span + np.array([-half, half]), label) for label in self._labels]

    def _nearest(self, xyz_m: Float32[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Which points belong to the cluster; for speed, grid cells of half the gap are linked instead of points."""
        if not len(xyz_m):
            return np.zeros(0, np.bool_)
        cells, cell_of, count = np.unique(
            np.floor(xyz_m / (self._gap_m / 2)).astype(np.int64), axis=0, return_inverse=True, return_counts=True
        )
        pairs = cKDTree(cells).query_pairs(2.0, output_type="ndarray")
        links = coo_array((np.ones(len(pairs), np.bool_), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
        groups, group_of_cell = connected_components(links, directed=False)
        points = np.bincount(group_of_cell, weights=count, minlength=groups)
        group_of = group_of_cell[cell_of.reshape(-1)]
        distance = np.bincount(group_of, weights=np.linalg.norm(xyz_m, axis=1), minlength=groups) / points
        distance[points < self._min_share * len(xyz_m)] = np.inf
        # if all clusters are smaller than `min_share`, the largest one is taken
        chosen = np.argmin(distance) if np.isfinite(distance).any() else np.argmax(points)
        return np.asarray(group_of == chosen)
