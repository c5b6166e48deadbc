"""The pictures of docs/gallery.md: what one 2D box per object gives on each kind of sensor, without any training."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from page import DOCS, save_jpeg
from PIL import Image
from scenes import image_boxes, recorded, street_frame
from scipy.spatial.transform import RigidTransform, Rotation

from annotator import draw_boxes
from annotator.detection.pretrained import base_weights
from annotator.detection.trained import read_trained
from annotator.geometry.iou import iou_3d
from annotator.project import BoxRotation
from annotator.rcv.config import RcvConfig
from annotator.recordings.clouds.virtual_camera import virtual_image
from annotator.synthetic import write_generated
from annotator.types import BoxKind, Camera, Detector, Frame, OrientedBox, Truth
from annotator.workflows.detectors import load_detector
from annotator.workflows.training.held_out import lifted

WIDTH, MOST_BYTES, BAR, GAP = 1100, 84_000, 30, 8
# Generated with `annotator generate`: name, preset, seed, frame, rotation.
RECORDED = (
    ("people", "people", 2, 0, BoxRotation.UPRIGHT),
    ("hands", "hands", 0, 0, BoxRotation.FREE),
    ("objects", "objects", 3, 0, BoxRotation.UPRIGHT),
)
# Seen by a LiDAR: name, seed, has a camera.
STREETS = (("street", 1, True), ("lidar", 11, False))
# Where the second picture is taken from: beside and above.
BESIDE_DEG, ABOVE_DEG = 50.0, 25.0
PAPER = 248


@dataclass(frozen=True)
class Measuring:
    """The base detector, and the settings that go with it."""

    detector: Detector
    config: RcvConfig

    @classmethod
    def load(cls) -> Measuring:
        weights = base_weights()
        config = RcvConfig(view_px=read_trained(weights.parent).image_size_px)
        return cls(load_detector(weights, "auto"), config.for_detector(BoxKind.BOX, True))

    def picture(self, frame: Frame, truths: list[Truth], rotation: BoxRotation) -> np.ndarray:
        """The 2D boxes and the 3D boxes that follow from them on the image, and the 3D boxes from another direction."""
        drawn = image_boxes(frame.camera, truths)
        measured = lifted(frame, drawn, self.detector, self.config, rotation)
        found = [box for box in measured if box is not None]
        ious = [iou_3d(box, truth.box) if box else 0.0 for box, truth in zip(measured, truths, strict=True)]
        text = f"2D boxes drawn (red): {len(drawn)}    3D boxes (green): {len(found)}    mean IoU: {np.mean(ious):.2f}"
        left = draw_boxes(frame, [*drawn, *found], thickness_px=1 if frame.camera.width_px < 700 else 2)
        right = from_beside(frame, found or [truth.box for truth in truths])
        both = np.hstack([left, np.full((len(left), GAP, 3), 255, np.uint8), right])
        scale = both.shape[1] / WIDTH
        bar = np.full((round(BAR * scale), both.shape[1], 3), 255, np.uint8)
        place = (round(6 * scale), round(21 * scale))
        cv2.putText(bar, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.55 * scale, (40, 40, 40), 1, cv2.LINE_AA)
        return np.vstack([bar, both])


def from_beside(frame: Frame, boxes: list[OrientedBox]) -> np.ndarray:
    """The cloud and the boxes, seen from beside and above the objects."""
    middle = np.mean([box.center_m for box in boxes], axis=0)
    reach = max(float(np.linalg.norm(box.center_m - middle) + np.linalg.norm(box.size_m) / 2) for box in boxes)
    up = np.array([0.0, -1.0, 0.0]) if frame.up is None else frame.up
    ahead = middle - up * (middle @ up)
    ahead = Rotation.from_rotvec(np.deg2rad(BESIDE_DEG) * up).apply(ahead / np.linalg.norm(ahead))
    z = np.cos(np.deg2rad(ABOVE_DEG)) * ahead - np.sin(np.deg2rad(ABOVE_DEG)) * up
    x = np.cross(z, up) / np.linalg.norm(np.cross(z, up))
    turn = Rotation.from_matrix(np.stack([x, np.cross(z, x), z]))
    T_beside_camera = RigidTransform.from_components([0.0, 0.0, 2.3 * reach] - turn.apply(middle), turn)
    width, height = frame.camera.width_px * 2 // 3, frame.camera.height_px
    camera = Camera(width, height, float(width), float(width), (width - 1) / 2, (height - 1) / 2)
    cloud = frame.cloud
    seen = type(cloud)(T_beside_camera.apply(cloud.xyz_m).astype(np.float32), cloud.rgb, cloud.reflectance)
    moved = [box.transformed(T_beside_camera) for box in boxes]
    points = virtual_image(camera, seen)
    points[~points.any(axis=2)] = PAPER
    return draw_boxes(Frame("beside", 0, camera, points, seen), moved)


def main() -> None:
    measuring = Measuring.load()
    with TemporaryDirectory() as folder:
        for name, preset, seed, index, rotation in RECORDED:
            write_generated(Path(folder) / name, preset, index + 1, seed)
            keep(name, measuring.picture(*recorded(Path(folder) / name, index), rotation))
    for name, seed, has_camera in STREETS:
        keep(name, measuring.picture(*street_frame(seed, has_camera), BoxRotation.UPRIGHT))


def keep(name: str, picture: np.ndarray) -> None:
    save_jpeg(Image.fromarray(picture), DOCS / f"gallery_{name}.jpg", WIDTH, MOST_BYTES)
