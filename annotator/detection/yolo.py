"""Runs a trained YOLO on many images at once.

One call takes images of any sizes, and the boxes of an image do not depend on the other images of the call.
Ultralytics' own predictor gives the same boxes (tests/detection/test_yolo.py), but is slower and pads
mixed sizes differently.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from annotator.detection.backends.choose import open_network
from annotator.detection.backends.network import Answer
from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.letterbox import Placement, fill_batch, place, to_pictures
from annotator.detection.selection import Candidates, candidates
from annotator.detection.suppression import suppress
from annotator.files import NETWORK_BYTES, read_file
from annotator.types import Box2D, Image, PseudoView, Region
from annotator.types.errors import DetectionError

# Maximum number of pixels of scaled images in one call of the network; bounds the memory.
MAX_CALL_PX = 64 * 320 * 320
MIN_SIDE_PX = 0.5
# Part of the fingerprint. Increase it when the same weights and settings give different boxes.
REVISION = 2


class YoloDetector:
    """A trained detector: takes RGB images of any size, returns boxes in pixels of each image.

    Attributes:
        weights: the weights file.
    """

    def __init__(self, weights: Path, config: DetectorConfig) -> None:
        """
        Args:
            weights: the file of a training run, or ultralytics' own detection weights.
            config: settings.

        Raises:
            ConfigError: the backend cannot use the device.
            DetectionError: the weights, the device or the backend cannot be used.
            MissingExtraError: the backend is not installed.
        """
        self.weights = weights
        self._config = config
        try:
            content = read_file(weights, NETWORK_BYTES)
        except FileNotFoundError as error:
            raise DetectionError(f"{weights}: no such weights file; train a detector first") from error
        except OSError as error:
            raise DetectionError(f"{weights}: cannot be read ({error.strerror}); train the detector again") from error
        self._network = open_network(weights, hashlib.sha256(content).hexdigest(), config)
        settings = f"{REVISION} {config.image_size_px} {config.confidence} {config.iou}"
        if config.edge_errors:
            settings += f" {sorted((label, errors.model_dump_json()) for label, errors in config.edge_errors.items())}"
        self._fingerprint = hashlib.sha256(content + settings.encode()).hexdigest()

    @property
    def labels(self) -> tuple[str, ...]:
        """Class names, in the order of the class numbers; a renamed one by its present name."""
        names = (self._config.names.get(label, label) for label in self._network.facts.labels)
        return tuple(dict.fromkeys(name for name in names if name is not None))

    @property
    def backend(self) -> Backend:
        """The backend that runs the network."""
        return self._network.backend

    @property
    def device(self) -> str:
        """Device of the network, in torch's notation: "cpu", "cuda", "cuda:1", "mps"."""
        return self._network.device

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the weights file and the settings.

        The backend is not part of it. All backends that `auto` chooses from give the same boxes, within a pixel and
        0.01 of the score (tests/detection/test_backends.py), so another machine may continue a batch. Boxes in bfloat16
        differ only slightly more (docs/detector_backends.md), so a change to or from it repeats no frames either.
        """
        return self._fingerprint

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        """One list of boxes per image, best score first, clipped to the image.

        Raises:
            DetectionError: an image is not (H, W, 3) uint8, or the backend fails.
        """
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
        """Pairs of image index and box, best score first."""
        facts, config = self._network.facts, self._config
        each = [candidates(answer, facts.end2end, config.confidence, facts.edge_spread) for answer in answers]
        picture = np.concatenate([np.array(group)[c.picture] for group, c in zip(groups, each, strict=True)])
        boxes = np.concatenate([c.boxes for c in each])
        scores = np.concatenate([c.scores for c in each])
        numbers = np.concatenate([c.numbers for c in each])
        # One suppression for the batch; groups separate images and classes. It leaves the boxes of end2end networks as
        # they are.
        kept = suppress(boxes, scores, picture * len(facts.labels) + numbers, config.iou)
        edges = to_pictures(boxes[kept], picture[kept], placements)
        wide_enough = (edges[:, 2:] - edges[:, :2] >= MIN_SIDE_PX).all(axis=1)
        spreads = _spreads(each, kept, picture, placements) if config.edge_errors else None
        for k in np.flatnonzero(wide_enough):
            x_min, y_min, x_max, y_max = edges[k].tolist()
            label, score = facts.labels[numbers[kept[k]]], float(scores[kept[k]])
            name = config.names.get(label, label)
            if name is None:
                continue
            errors = None if spreads is None else self._edge_sigma_px(label, *(part[k] for part in spreads))
            yield int(picture[kept[k]]), Box2D(name, x_min, y_min, x_max, y_max, score, errors)

    def _edge_sigma_px(
        self, label: str, spread_px: np.ndarray, scale: np.ndarray
    ) -> tuple[float, float, float, float] | None:
        """The expected errors of a box's edges, pixels of its image; None if those of its class are unknown."""
        errors = self._config.edge_errors.get(label)
        if errors is None:
            return None
        # rounded, since these numbers are stored with every proposal; not to 0, which would weigh infinitely much
        left, top, right, bottom = np.maximum(np.round(errors.of(spread_px) * scale, 3), 0.001).tolist()
        return left, top, right, bottom


def _spreads(
    each: Sequence[Candidates], kept: np.ndarray, picture: np.ndarray, placements: Sequence[Placement]
) -> tuple[Float32[np.ndarray, "k 4"], Float64[np.ndarray, "k 4"]] | None:
    """The edges' spreads of the kept boxes, pixels of the network's input, and the scales of these pixels.

    None if the network gives no spread.
    """
    spreads = [c.spreads for c in each if c.spreads is not None]
    if not spreads:
        return None
    scale = np.array([p.scale * 2 for p in placements], np.float64)[picture[kept]]
    return np.concatenate(spreads)[kept], scale


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
