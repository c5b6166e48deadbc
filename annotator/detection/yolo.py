"""Running a trained YOLO on many pictures at once.

Pictures of all sizes go in with one call, and a picture's answer does not depend on what else is asked with it;
ultralytics' own predictor gives the same boxes (tests/detection/test_yolo.py compares them), a good deal more slowly,
and pads differently where sizes are mixed.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from annotator.detection.backends.choose import open_network
from annotator.detection.backends.network import Answer
from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.letterbox import Placement, fill_batch, place, to_pictures
from annotator.detection.selection import candidates
from annotator.detection.suppression import suppress
from annotator.types import Box2D, Image, PseudoView, Region
from annotator.types.errors import DetectionError

# At most this many pixels of scaled pictures are worked on at once; it bounds the memory.
MAX_CALL_PX = 64 * 320 * 320
MIN_SIDE_PX = 0.5
# Part of the fingerprint; raise it when the same weights and settings would give other boxes.
REVISION = 2


class YoloDetector:
    """A trained detector: RGB pictures of any size in, boxes in their own pixels out.

    Attributes:
        weights: its weights file.
    """

    def __init__(self, weights: Path, config: DetectorConfig) -> None:
        """
        Args:
            weights: `detector.pt` of a training run, or any detection weights of ultralytics.
            config: settings.

        Raises:
            ConfigError: a backend that cannot use the device.
            DetectionError: unusable weights, device or backend.
            MissingExtraError: the backend is not installed.
        """
        self.weights = weights
        self._config = config
        try:
            content = weights.read_bytes()
        except FileNotFoundError as error:
            raise DetectionError(f"{weights}: no such weights file; train a detector first") from error
        except OSError as error:
            raise DetectionError(f"{weights}: cannot be read ({error.strerror}); train the detector again") from error
        self._network = open_network(weights, hashlib.sha256(content).hexdigest(), config)
        settings = f"{REVISION} {config.image_size_px} {config.confidence} {config.iou}"
        self._fingerprint = hashlib.sha256(content + settings.encode()).hexdigest()

    @property
    def labels(self) -> tuple[str, ...]:
        """Class names, in the order of the class numbers."""
        return self._network.facts.labels

    @property
    def backend(self) -> Backend:
        """What runs its network."""
        return self._network.backend

    @property
    def device(self) -> str:
        """Where its network runs, as torch names devices: "cpu", "cuda", "cuda:1", "mps"."""
        return self._network.device

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the weights file and the settings.

        The backend is not in it: all that auto chooses from give the same boxes, within a pixel and a hundredth of the
        score (tests/detection/test_backends.py), so what one machine has begun another one may go on with. Boxes in
        bfloat16 are nearly the same (docs/detector_backends.md), and no reason to do a frame again either.
        """
        return self._fingerprint

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        """One list of boxes an image, in the order given, best score first, clipped to the image.

        Raises:
            DetectionError: a picture is not (H, W, 3) uint8, or the backend fails.
        """
        pictures = [_checked(image.rgb) for image in images]
        stride = self._network.facts.stride
        placements = [
            place(picture.shape[:2], self._looked_at(image), stride)
            for picture, image in zip(pictures, images, strict=True)
        ]
        found: list[list[Box2D]] = [[] for _ in pictures]
        for part in _parts(placements):
            # Pictures that need the same canvas share a batch, so narrow ones are not computed with wide borders.
            by_canvas: dict[tuple[int, int], list[int]] = defaultdict(list)
            for index in part:
                by_canvas[placements[index].canvas].append(index)
            groups = list(by_canvas.values())
            answers = self._network.predict(
                [fill_batch([pictures[i] for i in group], [placements[i] for i in group]) for group in groups]
            )
            for index, box in self._boxes(groups, answers, placements):
                found[index].append(box)
        return found

    def _looked_at(self, image: Image) -> int:
        """The longer side of a picture in the network, pixels."""
        if isinstance(image, Region):
            return max(round(self._config.image_size_px * image.share), 1)
        return max(self._config.image_size_px, image.look_px if isinstance(image, PseudoView) else 0)

    def _boxes(
        self, groups: Sequence[Sequence[int]], answers: Sequence[Answer], placements: Sequence[Placement]
    ) -> Iterator[tuple[int, Box2D]]:
        """Boxes with the number of their picture, best score first."""
        facts, config = self._network.facts, self._config
        each = [candidates(answer, facts.end2end, config.confidence) for answer in answers]
        picture = np.concatenate([np.array(group)[c.picture] for group, c in zip(groups, each, strict=True)])
        boxes = np.concatenate([c.boxes for c in each])
        scores = np.concatenate([c.scores for c in each])
        numbers = np.concatenate([c.numbers for c in each])
        # One suppression for all: boxes of different pictures or classes never meet. Networks that need none are sure
        # of their boxes, and lose nothing by it.
        kept = suppress(boxes, scores, picture * len(facts.labels) + numbers, config.iou)
        edges = to_pictures(boxes[kept], picture[kept], placements)
        wide_enough = (edges[:, 2:] - edges[:, :2] >= MIN_SIDE_PX).all(axis=1)
        for k in np.flatnonzero(wide_enough):
            x_min, y_min, x_max, y_max = edges[k].tolist()
            label, score = facts.labels[numbers[kept[k]]], float(scores[kept[k]])
            yield int(picture[kept[k]]), Box2D(label, x_min, y_min, x_max, y_max, score)


def _parts(placements: Sequence[Placement]) -> Iterator[list[int]]:
    """Numbers of pictures that are worked on together."""
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
        raise DetectionError(f"a detector needs (height, width, 3) uint8 pictures, not {rgb.shape} {rgb.dtype}")
    return rgb
