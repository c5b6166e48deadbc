"""Fits the expected errors of a trained detector's edges on the validation images of its training."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from annotator.detection.config import DetectorConfig
from annotator.detection.dataset import DatasetManifest, TrainingSample
from annotator.detection.edge_errors import SPREAD_ITSELF, Refused, fit_edge_errors
from annotator.detection.trained import TrainedModel
from annotator.detection.yolo import YoloDetector
from annotator.files import read_text_file
from annotator.types import Box2D

LOG = logging.getLogger("annotator.detectors")

# Images that are read and run at once.
AT_ONCE = 512
# A detection belongs to a label with at least this IoU. Of several, the one with the highest
# score * (IoU + STRANGER_WEIGHT) is taken, as in the recursion (`rcv/cross_view.choose`).
MIN_IOU, STRANGER_WEIGHT = 0.1, 0.1
# Edges this close to the image's border are left out: what lies beyond it cannot be seen, pixels.
BORDER_PX = 1.0


@dataclass(frozen=True)
class _Picture:
    rgb: UInt8[np.ndarray, "h w 3"]


def with_edge_errors(trained: TrainedModel, dataset: Path, manifest: DatasetManifest, device: str) -> TrainedModel:
    """The trained view detector with the expected errors of its edges, for each class where they can be fitted.

    Without validation images of their own, with a network that gives no spread, or where the spread tells nothing,
    the detector stays without them.

    Args:
        dataset: folder of its training set.
        manifest: of that set.
        device: as for training.

    Raises:
        DetectionError: the detector or an image cannot be used.
    """
    if manifest.measured_on != "val":
        return trained
    config = DetectorConfig(
        image_size_px=trained.image_size_px,
        device=device,
        backend="torch",
        edge_errors=dict.fromkeys(trained.classes, SPREAD_ITSELF),
    )
    detector = YoloDetector(trained.weights, config)
    measured: dict[str, list[np.ndarray]] = defaultdict(list)
    images = [dataset / entry.image for entry in manifest.entries if entry.split == "val" and entry.boxes]
    for begin in range(0, len(images), AT_ONCE):
        part = images[begin : begin + AT_ONCE]
        pictures = [_Picture(TrainingSample(path, (), "", "").load()) for path in part]
        for path, picture, boxes in zip(part, pictures, detector.detect(pictures), strict=True):
            height, width = picture.rgb.shape[:2]
            scale = trained.image_size_px / max(height, width)
            for label in _labels(dataset, path, manifest.classes, width, height):
                box = _detection_of(label, boxes)
                if box is not None and box.edge_sigma_px is not None:
                    known = ~(_at_border(label, width, height) | _at_border(box, width, height))
                    errors = np.subtract(box.xyxy, label.xyxy)[known]
                    measured[label.label].append(np.stack([np.array(box.edge_sigma_px)[known], errors]) * scale)
    fitted = {}
    for name, parts in sorted(measured.items()):
        spread, error = np.concatenate(parts, axis=1)
        result = fit_edge_errors(spread, error)
        if isinstance(result, Refused):
            LOG.info("%s: no expected errors of the edges of %r: %s", trained.weights, name, result.reason)
        else:
            fitted[name] = result
    return trained.model_copy(update={"edge_errors": fitted})


def _labels(dataset: Path, image: Path, classes: Sequence[str], width_px: int, height_px: int) -> list[Box2D]:
    """The boxes of an image's label file, pixels."""
    boxes = []
    split = image.parent.name
    for line in read_text_file(dataset / "labels" / split / f"{image.stem}.txt").splitlines():
        number, *shares = line.split()
        x, y, width, height = (float(share) for share in shares)
        sides = np.array([width_px, height_px] * 2)
        edges = np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2]) * sides - 0.5
        boxes.append(Box2D(classes[int(number)], *edges.tolist()))
    return boxes


def _detection_of(label: Box2D, boxes: Sequence[Box2D]) -> Box2D | None:
    """The detection of a labelled object, or None."""
    near = [(box, iou) for box in boxes if box.label == label.label and (iou := _iou(box, label)) >= MIN_IOU]
    return max(near, key=lambda pair: pair[0].score * (STRANGER_WEIGHT + pair[1]))[0] if near else None


def _iou(a: Box2D, b: Box2D) -> float:
    width = min(a.x_max, b.x_max) - max(a.x_min, b.x_min)
    height = min(a.y_max, b.y_max) - max(a.y_min, b.y_min)
    shared = max(width, 0.0) * max(height, 0.0)
    return shared / (a.width_px * a.height_px + b.width_px * b.height_px - shared)


def _at_border(box: Box2D, width_px: int, height_px: int) -> Bool[np.ndarray, "4"]:
    inward: Float64[np.ndarray, "4"] = np.array(
        [box.x_min + 0.5, box.y_min + 0.5, width_px - 0.5 - box.x_max, height_px - 0.5 - box.y_max]
    )
    return inward <= BORDER_PX
