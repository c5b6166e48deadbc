"""Small scenes with known boxes, for the tests of the recursion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from annotator.types import Box2D, Camera, Detector, Frame, Image, OrientedBox, PointCloud, Truth

CAMERA = Camera(width_px=640, height_px=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5)


def box_surface(box: OrientedBox, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points (count, 3) on the faces of a box, uniform by area."""
    size = box.size_m
    areas = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis = rng.choice(3, count, p=areas / areas.sum())
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), axis] = rng.choice([-0.5, 0.5], count)
    return (points * size) @ box.rotation.T + box.center_m


def frame_with(
    boxes: list[OrientedBox], seed: int = 0, up: np.ndarray | None = None, wall_m: float = 4.0, key: str = "000000"
) -> tuple[Frame, list[Truth]]:
    """A frame that shows boxes in front of a wall; each box has 800 coloured points."""
    rng = np.random.default_rng(seed)
    parts = [box_surface(box, 800, rng) for box in boxes]
    u, v = rng.uniform(0, 640, 4000), rng.uniform(0, 480, 4000)
    wall = np.stack([(u - 319.5) / 500 * wall_m, (v - 239.5) / 500 * wall_m, np.full(4000, wall_m)], axis=1)
    xyz = np.concatenate([*parts, wall]).astype(np.float32)
    rgb = np.full((len(xyz), 3), 200, np.uint8)
    for k in range(len(boxes)):
        rgb[800 * k : 800 * (k + 1)] = [40 + 60 * k, 90, 30]
    image = np.zeros((480, 640, 3), np.uint8)
    frame = Frame(key=key, index=0, camera=CAMERA, rgb=image, cloud=PointCloud(xyz, rgb), up=up)
    return frame, [Truth("thing", box) for box in boxes]


def some_box(center: list[float], rotvec: list[float], size: list[float]) -> OrientedBox:
    """A box from a centre, a rotation vector (radians) and a size."""
    return OrientedBox.from_parts(np.array(center), Rotation.from_rotvec(rotvec).as_matrix(), np.array(size))


class Counting:
    """Forwards calls to a detector and records the number of images of each."""

    def __init__(self, inner: Detector) -> None:
        self.inner = inner
        self.calls: list[int] = []

    labels = property(lambda self: self.inner.labels)
    fingerprint = property(lambda self: self.inner.fingerprint)

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        self.calls.append(len(images))
        return self.inner.detect(images)
