"""Detectors that need no training.

`PerfectDetector` returns ground-truth boxes, exact or with noise, to measure the method without detector errors. The
other one returns the box around the nearest cluster of points on a pseudo-view.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.outline import box_on_image, clip_to_image, points_on_image
from annotator.types import Box2D, BoxKind, Camera, Frame, Image, PseudoView, Region, Truth
from annotator.types.errors import DetectionError

# Minimum width and height of a detected box, pixels.
MIN_SIDE_PX = 1.0
# An object is detected on a view that shows this many of its points, and this share of them.
LEAST_SHOWN, LEAST_SHARE_SHOWN = 3, 0.1


@dataclass(frozen=True, eq=False)
class Scene:
    """The ground truth of one frame.

    Attributes:
        xyz_m: (n, 3) its cloud, camera frame.
        points: for each object, the number of points in its box.
    """

    key: str
    camera: Camera
    xyz_m: Float32[np.ndarray, "n 3"]
    truths: tuple[Truth, ...]
    points: tuple[int, ...]

    @classmethod
    def of(cls, frame: Frame, truths: Sequence[Truth]) -> Scene:
        xyz_m = frame.cloud.xyz_m
        return cls(
            frame.key, frame.camera, xyz_m, tuple(truths), tuple(int(contains(t.box, xyz_m).sum()) for t in truths)
        )


class PerfectDetector:
    """Image and pseudo-view detector in one, from the true 3D boxes of given frames.

    On a `Frame`, or a `Region` of one, it returns the 2D extent of each object's 3D box (for silhouettes: of its
    points). On a `PseudoView`, it returns the same for each object of which the view shows enough points. Boxes are
    clipped to the image. Other frames raise an error.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        kind: BoxKind = BoxKind.BOX,
        jitter: float = 0.0,
        seed: int = 0,
        min_points: int = 1,
    ) -> None:
        """
        Args:
            jitter: standard deviation of the noise on each edge, as a share of the view's extent in that direction
                (on a camera image: of the box's extent).
            seed: seed of the noise, which depends on the image, not on the order of calls.
            min_points: objects with fewer points in the cloud are not detected.
        """
        self.labels = tuple(sorted({truth.label for scene in scenes for truth in scene.truths}))
        self._scenes = {scene.key: scene for scene in scenes}
        if len(self._scenes) != len(scenes):
            raise ValueError("two frames have the same key")
        self.box_kind, self._jitter, self._seed, self._min_points = kind, jitter, seed, min_points

    @classmethod
    def for_frame(
        cls,
        frame: Frame,
        truths: Sequence[Truth],
        kind: BoxKind = BoxKind.BOX,
        jitter: float = 0.0,
        seed: int = 0,
    ) -> PerfectDetector:
        """A detector for one frame and its pseudo-views."""
        return cls([Scene.of(frame, truths)], kind, jitter, seed)

    @property
    def fingerprint(self) -> str:
        """Hash of the boxes and the settings."""
        digest = hashlib.sha256(f"{self.box_kind} {self._jitter} {self._seed} {self._min_points}".encode())
        for key, scene in sorted(self._scenes.items()):
            digest.update(key.encode())
            for truth in scene.truths:
                digest.update(truth.label.encode() + truth.box.pose.tobytes())
                digest.update(truth.box.size_m.tobytes())
        return "perfect-" + digest.hexdigest()

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        """One list of boxes per image; the object with most points first."""
        # The views of one step share their points, so each cloud is searched once.
        counted: dict[int, tuple[Scene, Int64[np.ndarray, "k"]]] = {}
        detections = []
        for image in images:
            if isinstance(image, Frame):
                detections.append(self._on_image(image))
            elif isinstance(image, Region) and isinstance(image.of, Frame):
                detections.append(on_region(image, self._on_image(image.of), MIN_SIDE_PX))
            elif isinstance(image, PseudoView):
                if id(image.xyz_m) not in counted:
                    scene = self._scene_of(image.xyz_m)
                    shown = [contains(truth.box, image.xyz_m).sum() for truth in scene.truths]
                    counted[id(image.xyz_m)] = scene, np.array(shown, np.int64)
                detections.append(self._on_view(image, *counted[id(image.xyz_m)]))
            else:
                raise DetectionError(
                    f"a perfect detector takes frames, regions of frames and pseudo-views, not {type(image).__name__}"
                )
        return detections

    def _on_image(self, frame: Frame) -> list[Box2D]:
        scene = self._scenes.get(frame.key)
        if scene is None:
            raise DetectionError(
                f"the perfect detector has no truth for frame {frame.key}, only for {list(self._scenes)}"
            )
        size = (frame.camera.width_px, frame.camera.height_px)
        boxes = []
        for index in np.argsort(scene.points, kind="stable")[::-1]:
            truth = scene.truths[index]
            if self.box_kind is BoxKind.BOX:
                box = box_on_image(scene.camera, truth.box, truth.label, MIN_SIDE_PX)
            else:
                xyz_m = scene.xyz_m[contains(truth.box, scene.xyz_m)]
                box = points_on_image(scene.camera, xyz_m, truth.label, MIN_SIDE_PX)
            if box is not None and scene.points[index] >= self._min_points:
                span = np.array(box.xyxy).reshape(2, 2)
                rng = self._rng(frame.key.encode(), int(index))
                boxes.append(_noisy_box(truth.label, span, self._jitter * (span[1] - span[0]), size, rng))
        return [box for box in boxes if box is not None]

    def _scene_of(self, xyz_m: Float32[np.ndarray, "n 3"]) -> Scene:
        """The frame of a view: its points are points of its frame, so a few exact coordinates identify it."""
        probes = xyz_m[:: max(len(xyz_m) // 4, 1)]
        for scene in self._scenes.values():
            if len(self._scenes) == 1 or all((scene.xyz_m == probe).all(axis=1).any() for probe in probes):
                return scene
        raise DetectionError("the perfect detector has no truth for the frame of this pseudo-view")

    def _on_view(self, view: PseudoView, scene: Scene, shown: Int64[np.ndarray, "k"]) -> list[Box2D]:
        height_px, width_px = view.rgb.shape[:2]
        size = np.array([width_px, height_px], np.float64)
        geometry = view.axes.tobytes() + view.origin_m.tobytes() + np.float64(view.metres_per_px).tobytes()
        boxes = []
        for index in np.argsort(shown, kind="stable")[::-1]:
            truth, points = scene.truths[index], scene.points[index]
            if points < self._min_points or shown[index] < max(LEAST_SHOWN, LEAST_SHARE_SHOWN * points):
                continue
            if self.box_kind is BoxKind.BOX:
                xyz = box_corners(truth.box)
            else:
                xyz = view.xyz_m[contains(truth.box, view.xyz_m)].astype(np.float64)
            px = (xyz @ view.axes[:2].T - view.origin_m) / view.metres_per_px
            span = np.stack([px.min(axis=0), px.max(axis=0)])
            rng = self._rng(geometry, int(index))
            boxes.append(_noisy_box(truth.label, span, self._jitter * size, (width_px, height_px), rng))
        return [box for box in boxes if box is not None]

    def _rng(self, picture: bytes, index: int) -> np.random.Generator:
        """A generator that depends only on the seed, the image and the object."""
        digest = hashlib.sha256(picture + f" {index} {self._seed}".encode()).digest()
        return np.random.default_rng(int.from_bytes(digest[:8], "little"))


def on_region(region: Region, boxes: Iterable[Box2D], min_side_px: float) -> list[Box2D]:
    """Boxes of the whole image in pixels of the region, clipped to it; those with a shorter side are left out."""
    shifted = (box.shifted(-region.x_px, -region.y_px) for box in boxes)
    cut = (clip_to_image(box, region.width_px, region.height_px, min_side_px) for box in shifted)
    return [box for box in cut if box is not None]


def _noisy_box(
    label: str,
    span: Float64[np.ndarray, "2 2"],
    sigma_px: Float[np.ndarray, "2"],
    size: tuple[int, int],
    rng: np.random.Generator,
) -> Box2D | None:
    """The 2D box over `span` (rows low and high, columns x and y, pixels) with noise, clipped to the image."""
    moved = np.sort(span + rng.normal(size=(2, 2)) * sigma_px, axis=0)
    low, high = np.clip(moved, -0.5, np.array(size) - 0.5)
    if (high - low < MIN_SIDE_PX).any():
        return None
    return Box2D(label, float(low[0]), float(low[1]), float(high[0]), float(high[1]))


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
        """
        if not labels or not gap_m > 0 or not 0 <= min_share <= 1:
            raise ValueError(f"needs a label, gap_m > 0 and min_share in 0..1, not {labels}, {gap_m} and {min_share}")
        self.labels, self._gap_m, self._min_share = labels, gap_m, min_share
        self.fingerprint = f"nearest-cluster-1 {labels} {gap_m} {min_share}"

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        """One box per class on each pseudo-view; no box on a view without points."""
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
        return [view.box_px(span + np.array([-half, half]), label) for label in self.labels]

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
