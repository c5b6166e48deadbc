"""Running a trained YOLO on many pictures at once.

Pictures of all sizes go in with one call, and a picture's answer does not depend on what else is asked with it;
ultralytics' own predictor gives the same boxes (tests/detection/test_yolo.py compares them), a little more slowly, and
pads differently where sizes are mixed.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.letterbox import Placement, fill_batch, place, to_pictures
from annotator.detection.suppression import suppress
from annotator.detection.ultralytics_api import api, load_weights, pick_device
from annotator.types import Box2D, Image
from annotator.types.errors import DetectionError

# At most this many pixels of pictures are in the network at once; it bounds the memory, about 1 GB for a nano model.
MAX_BATCH_PX = 32 * 320 * 320
# Only the most certain candidates of a picture are compared for overlap.
MAX_CANDIDATES = 300
MIN_SIDE_PX = 0.5
# Part of the fingerprint; raise it when the same weights and settings would give other boxes.
REVISION = 1


class YoloDetector:
    """A trained detector: RGB pictures of any size in, boxes in their own pixels out.

    Attributes:
        weights: its weights file.
        backend: what runs its network.
    """

    backend: Backend = "torch"

    def __init__(self, weights: Path, config: DetectorConfig) -> None:
        """
        Args:
            weights: `detector.pt` of a training run, or any detection weights of ultralytics.
            config: settings.

        Raises:
            DetectionError: unusable weights or device.
        """
        self.weights = weights
        self._config = config
        self._device = pick_device(config.device)
        self._model = prepare_model(weights, self._device)
        self._stride = max(int(self._model.stride.max()), 32)
        self._labels = tuple(str(self._model.names[number]) for number in sorted(self._model.names))
        settings = f"{REVISION} {config.image_size_px} {config.confidence} {config.iou}"
        self._fingerprint = hashlib.sha256(weights.read_bytes() + settings.encode()).hexdigest()

    @property
    def labels(self) -> tuple[str, ...]:
        """Class names, in the order of the class numbers."""
        return self._labels

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the weights file and the settings."""
        return self._fingerprint

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        """One list of boxes an image, in the order given, best score first, clipped to the image.

        Raises:
            DetectionError: a picture is not (H, W, 3) uint8.
        """
        pictures = [_checked(image.rgb) for image in images]
        placements = [place(picture.shape[:2], self._config.image_size_px, self._stride) for picture in pictures]
        # Pictures that need the same canvas share a batch. So an answer does not depend on what else is asked,
        # and narrow pictures are not computed with wide borders.
        by_canvas: dict[tuple[int, int], list[int]] = defaultdict(list)
        for index, placement in enumerate(placements):
            by_canvas[placement.canvas].append(index)
        found: list[list[Box2D]] = [[] for _ in pictures]
        for (width_px, height_px), indices in by_canvas.items():
            at_once = max(MAX_BATCH_PX // (width_px * height_px), 1)
            for begin in range(0, len(indices), at_once):
                chunk = indices[begin : begin + at_once]
                answers = self._detect([pictures[i] for i in chunk], [placements[i] for i in chunk])
                for index, boxes in zip(chunk, answers, strict=True):
                    found[index] = boxes
        return found

    def _detect(self, pictures: Sequence[np.ndarray], placements: Sequence[Placement]) -> list[list[Box2D]]:
        torch = api().torch
        pixels = torch.from_numpy(fill_batch(pictures, placements))
        with torch.inference_mode():
            # The array is laid out picture, row, column, colour: seen as picture, colour, row, column it is
            # channels-last, the layout that the network is fastest in.
            batch = pixels.to(self._device).permute(0, 3, 1, 2).float().div_(255)
            answer = self._model(batch)
            picture, boxes, scores, numbers = select(
                answer[0] if isinstance(answer, tuple) else answer,
                len(self._labels),
                self._config.confidence,
                self._config.iou,
            )
        found: list[list[Box2D]] = [[] for _ in pictures]
        edges = to_pictures(boxes, picture, placements)
        wide_enough = (edges[:, 2:] - edges[:, :2] >= MIN_SIDE_PX).all(axis=1)
        for k in np.flatnonzero(wide_enough):
            x_min, y_min, x_max, y_max = edges[k].tolist()
            found[picture[k]].append(Box2D(self._labels[numbers[k]], x_min, y_min, x_max, y_max, float(scores[k])))
        return found


def prepare_model(weights: Path, device: Any) -> Any:
    """A model from a weights file, its normalisation folded into the convolutions, laid out for speed.

    Raises:
        DetectionError: the weights cannot be used.
    """
    torch = api().torch
    model = load_weights(weights, device)
    model = model.fuse(verbose=False).eval().requires_grad_(False)
    return model.to(memory_format=torch.channels_last)


def select(
    prediction: Any, classes: int, confidence: float, iou: float
) -> tuple[Int64[np.ndarray, "k"], Float32[np.ndarray, "k 4"], Float32[np.ndarray, "k"], Int64[np.ndarray, "k"]]:
    """The boxes that a whole batch's raw answer amounts to.

    Args:
        prediction: (n, 4 + classes, candidates) with centre, size and class scores, or from networks that need no
            suppression (n, candidates, 6) with x_min y_min x_max y_max score class.
        classes: number of classes.
        confidence, iou: as in `DetectorConfig`.

    Returns:
        for k boxes, best score first: number of the picture, x_min y_min x_max y_max in pixels from the batch's
        corner, score, class number.
    """
    torch = api().torch
    if prediction.shape[1] != 4 + classes:
        picture, candidate = torch.nonzero(prediction[..., 4] > confidence, as_tuple=True)
        boxes, scores, numbers = prediction[picture, candidate].float().split((4, 1, 1), dim=1)
        scores, numbers = scores[:, 0], numbers[:, 0].long()
    else:
        score, number = prediction[:, 4:].max(dim=1)
        score, candidate = score.topk(min(MAX_CANDIDATES, score.shape[1]), dim=1)
        picture, rank = torch.nonzero(score > confidence, as_tuple=True)
        candidate, scores = candidate[picture, rank], score[picture, rank].float()
        numbers = number[picture, candidate]
        middle, size = prediction[picture, :4, candidate].float().split(2, dim=1)
        boxes = torch.cat([middle - size / 2, middle + size / 2], dim=1)
    picture, boxes, scores, numbers = (part.cpu().numpy() for part in (picture, boxes, scores, numbers))
    # One suppression for the batch: boxes of different pictures or classes never meet. Networks that need none are
    # sure of their boxes, and lose nothing by it.
    kept = suppress(boxes, scores, picture * classes + numbers, iou)
    return picture[kept], boxes[kept], scores[kept], numbers[kept]


def _checked(rgb: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3 or 0 in rgb.shape:
        raise DetectionError(f"a detector needs (height, width, 3) uint8 pictures, not {rgb.shape} {rgb.dtype}")
    return rgb
