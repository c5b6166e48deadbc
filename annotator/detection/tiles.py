"""Cuts images into tiles of the training size, if the detector will see them at a larger size.

Objects in such an image are small: at the training size, they would cover one or two pixels. Tiles show them at the
size at which the detector will see them. Each image gives one tile around each object and one at a random place.
An object that is larger than a tile gets a larger tile, which is scaled down.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import zip_longest

import cv2
import numpy as np
from jaxtyping import UInt8

from annotator.detection.dataset import TrainingSample
from annotator.geometry.outline import clip_to_image
from annotator.types import Box2D

# An object is labelled on a tile if at least this share of its box lies on it.
MIN_SHARE = 0.3
# Side of the tile around an object that is too large for a normal tile, as a multiple of the object's longer side.
ROOM = 1.15


def tiled(samples: Iterable[TrainingSample], size_px: int) -> Iterator[TrainingSample]:
    """The samples, with each one whose `look_px` exceeds `size_px` replaced by its tiles.

    The positions of the tiles are random, but depend only on the image and its boxes.

    Args:
        size_px: longer side of training images, pixels.
    """
    for sample in samples:
        if sample.look_px <= size_px:
            yield sample
        else:
            yield from _tiles(sample, size_px)


def _tiles(sample: TrainingSample, size_px: int) -> Iterator[TrainingSample]:
    rgb = sample.load()
    height_px, width_px = rgb.shape[:2]
    scale = sample.look_px / max(height_px, width_px)
    if scale != 1:
        size = (max(round(width_px * scale), 1), max(round(height_px * scale), 1))
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    scales = (rgb.shape[1] / width_px, rgb.shape[0] / height_px)  # the size was rounded
    boxes = [(_scaled(box, *scales), uid) for box, uid in zip_longest(sample.boxes, sample.label_uids)]
    rng = np.random.default_rng(list(hashlib.sha256(rgb.tobytes() + repr(sample.boxes).encode()).digest()))
    for box, _ in boxes:
        yield _tile(sample, rgb, boxes, _corner_around(rgb, box, size_px, rng))
    yield _tile(sample, rgb, boxes, _corner_anywhere(rgb, size_px, rng))


def _scaled(box: Box2D, scale_x: float, scale_y: float) -> Box2D:
    """The box on the scaled image. Box edges are measured from the centre of the first pixel, not from its corner."""
    x_min, x_max = ((x + 0.5) * scale_x - 0.5 for x in (box.x_min, box.x_max))
    y_min, y_max = ((y + 0.5) * scale_y - 0.5 for y in (box.y_min, box.y_max))
    return replace(box, x_min=x_min, y_min=y_min, x_max=x_max, y_max=y_max)


Corner = tuple[int, int, int]
"""First column and row of a tile, and its side, pixels; a tile is clipped to its image."""


def _corner_around(rgb: UInt8[np.ndarray, "h w 3"], box: Box2D, size_px: int, rng: np.random.Generator) -> Corner:
    """A random tile that contains the visible part of a box; larger than `size_px` if the box is."""
    # the columns and rows that the box touches, as half-open ranges
    edges = ((box.x_min, box.x_max), (box.y_min, box.y_max))
    spans = [(math.floor(low + 0.5), math.ceil(high + 0.5)) for low, high in edges]
    longest = max(end - begin for begin, end in spans)
    side = size_px if longest <= size_px else round(ROOM * longest)
    begins = []
    for (begin, end), length in zip(spans, rgb.shape[1::-1], strict=True):
        first, last = np.clip([end - side, begin], 0, max(length - side, 0))
        begins.append(int(rng.integers(first, last, endpoint=True)))
    return begins[0], begins[1], side


def _corner_anywhere(rgb: UInt8[np.ndarray, "h w 3"], size_px: int, rng: np.random.Generator) -> Corner:
    x, y = (int(rng.integers(0, max(length - size_px, 0), endpoint=True)) for length in rgb.shape[1::-1])
    return x, y, size_px


def _tile(
    sample: TrainingSample, rgb: UInt8[np.ndarray, "h w 3"], boxes: list[tuple[Box2D, str | None]], corner: Corner
) -> TrainingSample:
    x, y, side = corner
    cut = np.ascontiguousarray(rgb[y : y + side, x : x + side])
    shown: list[Box2D] = []
    uids: list[str] = []
    for box, uid in boxes:
        moved = box.shifted(-x, -y)
        if _share_on(cut, moved) >= MIN_SHARE:
            shown.append(moved)
            uids += [] if uid is None else [uid]
    return replace(sample, rgb=cut, boxes=tuple(shown), label_uids=tuple(uids), look_px=0)


def _share_on(rgb: UInt8[np.ndarray, "h w 3"], box: Box2D) -> float:
    """The share of a box's area that lies on the image."""
    cut = clip_to_image(box, rgb.shape[1], rgb.shape[0])
    return 0.0 if cut is None else cut.width_px * cut.height_px / (box.width_px * box.height_px)
