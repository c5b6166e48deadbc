"""A detector that also looks at the mirror image of each view, to measure what that gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from annotator.types import Box2D, Detector, Image, PseudoView

# A box and the one of the mirror image are the same object from this IoU on.
SAME_IOU = 0.5


@dataclass(frozen=True, eq=False)
class Mirrored:
    """Averages each box with that of the left-right mirror image; takes twice as long. Only for pseudo-views."""

    detector: Detector

    @property
    def labels(self) -> tuple[str, ...]:
        return self.detector.labels

    @property
    def fingerprint(self) -> str:
        return self.detector.fingerprint + " and mirrored"

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        """As `Detector.detect`."""
        mirrored = [replace(cast(PseudoView, image), rgb=np.ascontiguousarray(image.rgb[:, ::-1])) for image in images]
        plain, other = self.detector.detect(images), self.detector.detect(mirrored)
        return [
            _averaged(boxes, [_mirror_image(box, image.rgb.shape[1]) for box in twins])
            for image, boxes, twins in zip(images, plain, other, strict=True)
        ]


def _mirror_image(box: Box2D, width_px: int) -> Box2D:
    sigma = box.edge_sigma_px
    swapped = None if sigma is None else (sigma[2], sigma[1], sigma[0], sigma[3])
    x_min, x_max = width_px - 1 - box.x_max, width_px - 1 - box.x_min
    return replace(box, x_min=x_min, x_max=x_max, edge_sigma_px=swapped)


def _averaged(boxes: Sequence[Box2D], twins: Sequence[Box2D]) -> list[Box2D]:
    """Each box, averaged with the twin that overlaps it most, if there is one; a lonely box keeps half of its score."""
    found = []
    for box in boxes:
        same = max((twin for twin in twins if twin.label == box.label), key=lambda twin: _iou(box, twin), default=None)
        if same is None or _iou(box, same) < SAME_IOU:
            found.append(replace(box, score=box.score / 2))
            continue
        edges = (np.array(box.xyxy) + np.array(same.xyxy)) / 2
        x_min, y_min, x_max, y_max = edges.tolist()
        mean = replace(box, x_min=x_min, y_min=y_min, x_max=x_max, y_max=y_max, score=(box.score + same.score) / 2)
        found.append(mean)
    return sorted(found, key=lambda box: -box.score)


def _iou(a: Box2D, b: Box2D) -> float:
    width = min(a.x_max, b.x_max) - max(a.x_min, b.x_min)
    height = min(a.y_max, b.y_max) - max(a.y_min, b.y_min)
    shared = max(width, 0.0) * max(height, 0.0)
    return shared / (a.width_px * a.height_px + b.width_px * b.height_px - shared)
