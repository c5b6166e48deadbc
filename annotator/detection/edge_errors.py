"""The expected error of a detected edge, from the spread that the network predicts for it.

The spread (`backends/torch_network.py`) is the width of a distribution, not an error. How large an error goes with it
is fitted on the validation images of a detector's training.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from annotator.detection.config import DetectorConfig, EdgeErrors
from annotator.detection.dataset import DatasetManifest, read_picture
from annotator.detection.trained import TrainedModel
from annotator.detection.yolo import YoloDetector
from annotator.files import read_text_file
from annotator.geometry.iou import box_iou
from annotator.geometry.outline import edges_of
from annotator.types import Box2D

# A fit needs at least this many edges, and must explain the errors better than one constant by this log-likelihood.
MIN_EDGES, MIN_GAIN = 200, 0.02
MIN_EXPONENT = 0.1
# Spreads beyond these percentiles are treated as these, percent.
SEEN_SPREADS = (2.0, 98.0)
# Errors above this multiple of the expected one are treated as that: the detection is of another object.
MOST_ERRORS = 6.0
# Smallest spread and error that are told apart, pixels.
LEAST_PX = 0.01
# Newton's steps of a fit, and fits, each with the outliers of the last one.
STEPS, FITS = 50, 4


# Gives out the spreads as they are.
SPREAD_ITSELF = EdgeErrors(factor=1.0, exponent=1.0, least_px=LEAST_PX, most_px=1e6)


def fit_edge_errors(spread_px: Float64[np.ndarray, "n"], error_px: Float64[np.ndarray, "n"]) -> EdgeErrors | str:
    """The map under which the errors are most likely, if they have a Laplace distribution; or why there is none.

    Args:
        spread_px, error_px: of edges on images that the network was not trained on; errors may have a sign.
    """
    if len(spread_px) < MIN_EDGES:
        return f"{len(spread_px)} edges to fit to; needs {MIN_EDGES}"
    least, most = (max(value, LEAST_PX) for value in np.percentile(spread_px, SEEN_SPREADS).tolist())
    size = np.abs(error_px) + LEAST_PX
    logs = np.log(np.clip(spread_px, least, most))
    rows = np.stack([np.ones_like(logs), logs], axis=1)
    expected = np.full(len(size), np.median(size) / np.log(2))
    for _ in range(FITS):
        within = np.minimum(size, MOST_ERRORS * expected)
        unknowns = _most_likely(rows, within)
        expected = np.exp(rows @ unknowns)
    gain = float((np.log(within.mean()) + 1) - (np.log(expected) + within / expected).mean())
    if unknowns[1] < MIN_EXPONENT or gain < MIN_GAIN:
        return f"the spread hardly tells the error (exponent {unknowns[1]:.2f}, gain {gain:.3f})"
    return EdgeErrors(
        factor=float(np.exp(unknowns[0])),
        exponent=float(unknowns[1]),
        least_px=least,
        most_px=most,
        edges=len(spread_px),
        gain=gain,
    )


def _most_likely(rows: Float64[np.ndarray, "n 2"], size: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "2"]:
    """The logarithm of the expected error as a linear function of the rows, for errors with a Laplace distribution."""
    unknowns = np.array([np.log(size.mean()), 0.0])
    for _ in range(STEPS):
        # minus the log-likelihood, sum(log b + size / b) with b = exp(rows @ unknowns), is convex: Newton's steps
        ratio = size * np.exp(-rows @ unknowns)
        curvature = rows.T @ (rows * ratio[:, None]) + 1e-9 * len(rows) * np.eye(2)
        step = np.linalg.solve(curvature, rows.T @ (ratio - 1))
        unknowns = unknowns + np.clip(step, -1.0, 1.0)
        if np.abs(step).max() < 1e-9:
            break
    return unknowns


LOG = logging.getLogger("annotator.detectors")

# Images that are read and run at once.
AT_ONCE = 512
# A detection belongs to a label with at least this IoU. Of several, the one with the highest
# score * (IoU + STRANGER_WEIGHT) is taken, as in the recursion (`rcv/measure.choose_all`).
MIN_IOU, STRANGER_WEIGHT = 0.1, 0.1
# Edges this close to the image's border are left out: what lies beyond it cannot be seen, pixels.
BORDER_PX = 1.0


def with_edge_errors(trained: TrainedModel, dataset: Path, manifest: DatasetManifest, device: str) -> TrainedModel:
    """The trained view detector with the expected errors of its edges, for each class where they can be fitted.

    Without validation images of their own, with a network that gives no spread, or where the spread tells nothing,
    the detector stays without them.
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
        pictures = [read_picture(path) for path in part]
        for path, picture, boxes in zip(part, pictures, detector.detect(pictures), strict=True):
            height, width = picture.rgb.shape[:2]
            scale = trained.image_size_px / max(height, width)
            for label in read_boxes(dataset, path, manifest.classes, width, height):
                box = _detection_of(label, boxes)
                if box is not None and box.edge_sigma_px is not None:
                    known = ~(_at_border(label, width, height) | _at_border(box, width, height))
                    errors = np.subtract(box.xyxy, label.xyxy)[known]
                    measured[label.label].append(np.stack([np.array(box.edge_sigma_px)[known], errors]) * scale)
    fitted = {}
    for name, parts in sorted(measured.items()):
        spread, error = np.concatenate(parts, axis=1)
        result = fit_edge_errors(spread, error)
        if isinstance(result, str):
            LOG.info("%s: no expected errors of the edges of %r: %s", trained.weights, name, result)
        else:
            fitted[name] = result
    return trained.model_copy(update={"edge_errors": fitted})


def read_boxes(dataset: Path, image: Path, classes: Sequence[str], width_px: int, height_px: int) -> list[Box2D]:
    """The boxes of an image's label file, pixels."""
    boxes = []
    split = image.parent.name
    for line in read_text_file(dataset / "labels" / split / f"{image.stem}.txt").splitlines():
        number, *shares = line.split()
        edges = edges_of(np.array(shares, np.float64), width_px, height_px)
        boxes.append(Box2D(classes[int(number)], *edges.tolist()))
    return boxes


def _detection_of(label: Box2D, boxes: Sequence[Box2D]) -> Box2D | None:
    near = [(box, iou) for box in boxes if box.label == label.label and (iou := box_iou(box, label)) >= MIN_IOU]
    return max(near, key=lambda pair: pair[0].score * (STRANGER_WEIGHT + pair[1]))[0] if near else None


def _at_border(box: Box2D, width_px: int, height_px: int) -> Bool[np.ndarray, "4"]:
    inward: Float64[np.ndarray, "4"] = np.array(
        [box.x_min + 0.5, box.y_min + 0.5, width_px - 0.5 - box.x_max, height_px - 0.5 - box.y_max]
    )
    return inward <= BORDER_PX
