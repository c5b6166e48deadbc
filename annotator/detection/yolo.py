"""Runs a trained YOLO on many images at once.

One call takes images of any sizes, and the boxes of an image do not depend on the other images of the call.
Ultralytics' own predictor gives the same boxes (tests/detection/test_yolo.py), but is slower and pads
mixed sizes differently.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8

from annotator.detection.backends.choose import open_network
from annotator.detection.backends.network import Answer
from annotator.detection.config import DetectorConfig
from annotator.files import NETWORK_BYTES, read_file
from annotator.types import Box2D, Image, PseudoView, Region
from annotator.types.errors import DetectionError

# Grey of the border. Networks are trained with it, and pseudo-views have it as background.
GREY = 114
# Canvases up to this size are square: wider borders take less time than several canvas sizes.
SQUARE_UP_TO_PX = 128


@dataclass(frozen=True)
class Placement:
    """How an image is scaled and padded for a network, all in pixels.

    Attributes:
        scaled_width_px, scaled_height_px: its size in the batch.
        canvas: (width, height) including the border.
    """

    width_px: int
    height_px: int
    scaled_width_px: int
    scaled_height_px: int
    canvas: tuple[int, int]

    @property
    def corner(self) -> tuple[int, int]:
        """Left and top border; an odd pixel is added on the right or at the bottom."""
        return (self.canvas[0] - self.scaled_width_px) // 2, (self.canvas[1] - self.scaled_height_px) // 2

    @property
    def scale(self) -> tuple[float, float]:
        """Pixels of the image per pixel of the batch, in x and y."""
        return self.width_px / self.scaled_width_px, self.height_px / self.scaled_height_px


def place(size: tuple[int, int], longer_side_px: int, stride: int) -> Placement:
    """Scales the longer side of a (height, width) image to `longer_side_px` and pads it to multiples of `stride`.

    Small images get square canvases, so that all images of a call share one size.
    """
    height_px, width_px = size
    scale = longer_side_px / max(height_px, width_px)
    scaled_width_px, scaled_height_px = max(round(width_px * scale), 1), max(round(height_px * scale), 1)
    canvas = (-(-scaled_width_px // stride) * stride, -(-scaled_height_px // stride) * stride)
    if longer_side_px <= SQUARE_UP_TO_PX:
        canvas = (max(canvas), max(canvas))
    return Placement(width_px, height_px, scaled_width_px, scaled_height_px, canvas)


def fill_batch(pictures: Sequence[np.ndarray], placements: Sequence[Placement]) -> UInt8[np.ndarray, "n h w 3"]:
    """A batch of images that share a canvas size, each centred on its canvas."""
    width_px, height_px = placements[0].canvas
    batch = np.full((len(pictures), height_px, width_px, 3), GREY, np.uint8)
    for target, picture, placement in zip(batch, pictures, placements, strict=True):
        size = (placement.scaled_width_px, placement.scaled_height_px)
        left, top = placement.corner
        if picture.shape[1::-1] != size:
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR)
        target[top : top + size[1], left : left + size[0]] = picture
    return batch


def to_pictures(
    boxes: Float[np.ndarray, "k 4"],
    picture: Int64[np.ndarray, "k"],
    placements: Sequence[Placement],
) -> Float64[np.ndarray, "k 4"]:
    """Maps boxes from canvases to their images, and clips them to the images.

    Resizing preserves image corners, so the mapping measures from the corner of the first pixel. The result is
    measured from its centre, half a pixel further in.

    Args:
        boxes: x_min y_min x_max y_max, pixels from the corner of the canvas.
    """
    border = np.array([p.corner * 2 for p in placements], np.float64)[picture]
    size = np.array([(p.width_px, p.height_px) * 2 for p in placements], np.float64)[picture]
    scale = np.array([p.scale * 2 for p in placements], np.float64)[picture]
    return np.clip((boxes - border) * scale, 0, size) - 0.5


# Only the candidates with the highest scores of an image enter non-maximum suppression.
MAX_CANDIDATES = 300


@dataclass(frozen=True, eq=False)
class Candidates:
    """The candidates of a batch before non-maximum suppression.

    Attributes:
        picture: (k,) index of the image in its batch.
        boxes: (k, 4) x_min y_min x_max y_max, pixels from the corner of the batch's canvas.
        scores: (k,) 0..1.
        numbers: (k,) class numbers.
        spreads: (k, 4) spread of each edge in the order of `boxes`, pixels; None if the network gives none.
    """

    picture: Int64[np.ndarray, "k"]
    boxes: Float32[np.ndarray, "k 4"]
    scores: Float32[np.ndarray, "k"]
    numbers: Int64[np.ndarray, "k"]
    spreads: Float32[np.ndarray, "k 4"] | None = None


def candidates(
    prediction: Float32[np.ndarray, "n c a"], end2end: bool, confidence: float, edge_spread: bool = False
) -> Candidates:
    """The candidates of each image whose score exceeds `confidence`, image by image.

    Args:
        prediction: one column per anchor: four numbers of its box, the score of each class, and the spread of each edge
            if `edge_spread`. The box is centre and size, or x_min y_min x_max y_max if `end2end`.
        end2end: whether the network works without suppression (YOLO26, YOLOv10).
        confidence: score threshold.
        edge_spread: as in `NetworkFacts`.
    """
    classes = prediction[:, 4:-4] if edge_spread else prediction[:, 4:]
    if end2end:  # as in ultralytics, one anchor may give boxes of two classes
        picture, number, anchor = np.nonzero(classes > confidence)
    else:
        best = classes.max(axis=1)
        picture, anchor = np.nonzero(best > confidence)
        number = classes[picture, :, anchor].argmax(axis=1)
    scores = classes[picture, number, anchor]
    boxes = prediction[picture, :4, anchor]
    if not end2end:
        middle, half = boxes[:, :2], boxes[:, 2:] / 2
        boxes = np.concatenate([middle - half, middle + half], axis=1)
    spreads = prediction[picture, -4:, anchor] if edge_spread else None
    return Candidates(picture, boxes, scores, number, spreads)


def suppressed(found: Candidates, iou: float) -> Int64[np.ndarray, "k"]:
    """Indices of what greedy non-maximum suppression keeps, image by image, the best score first.

    Boxes of the same image and class suppress each other if their IoU exceeds `iou`. `found.picture` ascends.
    """
    edges = found.boxes.astype(np.float64)
    sized = np.concatenate([edges[:, :2], edges[:, 2:] - edges[:, :2]], axis=1)
    kept = [np.empty(0, np.int64)]
    begins = np.flatnonzero(np.diff(found.picture, prepend=-1))
    for begin, end in pairwise([*begins.tolist(), len(edges)]):
        scores, numbers = found.scores[begin:end].tolist(), found.numbers[begin:end].tolist()
        best = cv2.dnn.NMSBoxesBatched(sized[begin:end].tolist(), scores, numbers, 0.0, iou, top_k=MAX_CANDIDATES)
        kept.append(np.asarray(best, np.int64) + begin)
    return np.concatenate(kept)


# Maximum number of pixels of scaled images in one call of the network; bounds the memory.
MAX_CALL_PX = 64 * 320 * 320
MIN_SIDE_PX = 0.5
# Part of the fingerprint. Increase it when the same weights and settings give different boxes.
REVISION = 2


class YoloDetector:
    """A trained detector: takes RGB images of any size, returns boxes in pixels of each image.

    Attributes:
        labels: class names, in the order of the class numbers; a renamed one by its present name.
        device: of the network, in torch's notation: "cpu", "cuda", "cuda:1", "mps".
        fingerprint: SHA-256 of the weights file and the settings. The backend is not part of it. All backends that
            `auto` chooses from give the same boxes, within a pixel and 0.01 of the score
            (tests/detection/test_backends.py), so another machine may continue a batch. Boxes in bfloat16 differ only
            slightly more (docs/detector_backends.md), so a change to or from it repeats no frames either.
    """

    def __init__(self, weights: Path, config: DetectorConfig) -> None:
        self.weights = weights
        self._config = config
        try:
            content = read_file(weights, NETWORK_BYTES)
        except FileNotFoundError as error:
            raise DetectionError(f"{weights}: no such weights file; train a detector first") from error
        except OSError as error:
            raise DetectionError(f"{weights}: cannot be read ({error.strerror}); train the detector again") from error
        self._network = open_network(weights, hashlib.sha256(content).hexdigest(), config)
        self.backend, self.device = self._network.backend, self._network.device
        names = (config.names.get(label, label) for label in self._network.facts.labels)
        self.labels = tuple(dict.fromkeys(name for name in names if name is not None))
        settings = f"{REVISION} {config.image_size_px} {config.confidence} {config.iou}"
        if config.edge_errors:
            settings += f" {sorted((label, errors.model_dump_json()) for label, errors in config.edge_errors.items())}"
        self.fingerprint = hashlib.sha256(content + settings.encode()).hexdigest()

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        """One list of boxes per image, best score first, clipped to the image."""
        pictures = [_checked(image.rgb) for image in images]
        stride = self._network.facts.stride
        placements = [
            place(picture.shape[:2], self._scaled_side_px(image), stride)
            for picture, image in zip(pictures, images, strict=True)
        ]
        boxes: list[list[Box2D]] = [[] for _ in pictures]
        for part in _parts(placements):
            # Images with the same canvas share a batch, so that narrow images get no wide borders.
            by_canvas: dict[tuple[int, int], list[int]] = defaultdict(list)
            for index in part:
                by_canvas[placements[index].canvas].append(index)
            groups = list(by_canvas.values())
            answers = self._network.predict(
                [fill_batch([pictures[i] for i in group], [placements[i] for i in group]) for group in groups]
            )
            for index, box in self._boxes(groups, answers, placements):
                boxes[index].append(box)
        return boxes

    def _scaled_side_px(self, image: Image) -> int:
        """The longer side of an image after scaling for the network, pixels."""
        if isinstance(image, Region):
            return max(round(self._config.image_size_px * image.share), 1)
        return max(self._config.image_size_px, image.look_px if isinstance(image, PseudoView) else 0)

    def _boxes(
        self, groups: Sequence[Sequence[int]], answers: Sequence[Answer], placements: Sequence[Placement]
    ) -> Iterator[tuple[int, Box2D]]:
        """Pairs of image index and box, the best of each image first."""
        facts, config = self._network.facts, self._config
        for group, answer in zip(groups, answers, strict=True):
            found = candidates(answer, facts.end2end, config.confidence, facts.edge_spread)
            # it leaves the boxes of end2end networks as they are
            kept = suppressed(found, config.iou)
            own = [placements[index] for index in group]
            edges = to_pictures(found.boxes[kept], found.picture[kept], own)
            scale = np.array([p.scale * 2 for p in own], np.float64)[found.picture[kept]]
            wide_enough = (edges[:, 2:] - edges[:, :2] >= MIN_SIDE_PX).all(axis=1)
            for k in np.flatnonzero(wide_enough).tolist():
                label = facts.labels[found.numbers[kept[k]]]
                name = config.names.get(label, label)
                if name is not None:
                    spread = None if found.spreads is None else found.spreads[kept[k]]
                    errors = self._edge_sigma_px(label, spread, scale[k])
                    score, (x_min, y_min, x_max, y_max) = float(found.scores[kept[k]]), edges[k].tolist()
                    yield group[found.picture[kept[k]]], Box2D(name, x_min, y_min, x_max, y_max, score, errors)

    def _edge_sigma_px(
        self, label: str, spread_px: np.ndarray | None, scale: np.ndarray
    ) -> tuple[float, float, float, float] | None:
        """The expected errors of a box's edges, pixels of its image; None if those of its class are unknown.

        Args:
            spread_px: of the edges, pixels of the network's input; None if the network gives none.
            scale: of these pixels.
        """
        errors = self._config.edge_errors.get(label)
        if errors is None or spread_px is None:
            return None
        # rounded, since these numbers are stored with every proposal; not to 0, which would weigh infinitely much
        left, top, right, bottom = np.maximum(np.round(errors.of(spread_px) * scale, 3), 0.001).tolist()
        return left, top, right, bottom


def _parts(placements: Sequence[Placement]) -> Iterator[list[int]]:
    """Batches of image indices, each within `MAX_CALL_PX`."""
    part: list[int] = []
    pixels = 0
    for index, placement in enumerate(placements):
        own = placement.canvas[0] * placement.canvas[1]
        if part and pixels + own > MAX_CALL_PX:
            yield part
            part, pixels = [], 0
        part.append(index)
        pixels += own
    if part:
        yield part


def _checked(rgb: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3 or 0 in rgb.shape:
        raise DetectionError(f"a detector needs (height, width, 3) uint8 images, not {rgb.shape} {rgb.dtype}")
    return rgb
