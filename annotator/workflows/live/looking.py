"""Where the image detector looks: at all of a frame, or only around the objects of the frame before.

A network takes as long for one camera image as for a dozen pseudo-views. While objects are being followed, it is enough
to look where they were; every few frames, and whenever one of them is not found there, the whole image is looked at.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

from annotator.geometry.outline import box_on_image
from annotator.rcv.config import RcvConfig
from annotator.rcv.cross_view import box_iou
from annotator.rcv.seeds import Seed
from annotator.types import Box2D, Detector, Frame, Region

# A new object waits at most so many frames until it is seen.
WHOLE_EVERY = 5
# A region is at least so many times as large as its object was, which has moved; where that is not enough, the whole
# image is looked at.
ROOM = 1.3
# Sides of regions are so many parts of the image's longer side, and no less than three: networks compute whole steps of
# 32 px, and look at an image with 256.
PARTS, LEAST_PARTS = 8, 3
# Regions that make up more of the image than this share save nothing.
MOST_SHARE = 0.6
# An edge this near to the border of a region, pixels of the image, may lie beyond it.
BORDER_PX = 2.0
# Two boxes that overlap more are one object, found twice.
SAME_IOU = 0.5


class Looking:
    """Boxes on the images of one frame after the other, the last one's objects at hand."""

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self._left = 0

    def boxes(self, frame: Frame, seeds: Sequence[Seed], config: RcvConfig) -> list[Box2D]:
        """The boxes on a frame's image.

        Args:
            seeds: the objects that were there a moment ago; without any the whole image is looked at.
        """
        if seeds and self._left > 0:
            followed = self._followed(frame, seeds, config)
            if followed is not None:
                self._left -= 1
                return followed
        self._left = WHOLE_EVERY - 1
        (found,) = self._detector.detect([frame])
        return found

    def lost(self) -> None:
        """An object of the frame before is gone: the next look is at the whole image."""
        self._left = 0

    def _followed(self, frame: Frame, seeds: Sequence[Seed], config: RcvConfig) -> list[Box2D] | None:
        """One box a seed, from around where it was; None where that does not do."""
        outlines = [box_on_image(frame.camera, seed.box, seed.label) for seed in seeds]
        known = [outline for outline in outlines if outline is not None]
        regions = [region_around(frame, outline) for outline in known]
        area = sum(region.width_px * region.height_px for region in regions)
        if len(known) < len(seeds) or area > MOST_SHARE * frame.rgb.shape[0] * frame.rgb.shape[1]:
            return None
        found: list[Box2D] = []
        for outline, region, boxes in zip(known, regions, self._detector.detect(regions), strict=True):
            box = _same_object(outline, region, boxes, config)
            if box is None:
                return None
            found.append(box)
        if any(box_iou(a, b) > SAME_IOU for a, b in itertools.combinations(found, 2)):
            return None
        return found


def region_around(frame: Frame, box: Box2D) -> Region:
    """The part of a frame's image around a box."""
    height_px, width_px = frame.rgb.shape[:2]
    part_px = max(width_px, height_px) / PARTS
    parts = max(math.ceil(ROOM * max(box.width_px, box.height_px) / part_px), LEAST_PARTS)
    side_px = round(parts * part_px)
    begins, sizes = [], []
    for low, high, length_px in ((box.x_min, box.x_max, width_px), (box.y_min, box.y_max, height_px)):
        size = min(side_px, length_px)
        begins.append(min(max(round((low + high - size) / 2), 0), length_px - size))
        sizes.append(size)
    return Region(frame, *begins, *sizes)


def _same_object(outline: Box2D, region: Region, boxes: Sequence[Box2D], config: RcvConfig) -> Box2D | None:
    """The box, on the whole image, that is most likely where the object is now."""
    on_image = [
        Box2D(
            box.label,
            box.x_min + region.x_px,
            box.y_min + region.y_px,
            box.x_max + region.x_px,
            box.y_max + region.y_px,
            box.score,
        )
        for box in boxes
        if box.label == outline.label and box.score >= config.min_image_score
    ]
    best = max(on_image, key=lambda box: box_iou(box, outline), default=None)
    if best is None or box_iou(best, outline) < config.warm.min_image_iou or _is_cut(region, best):
        return None
    return best


def _is_cut(region: Region, box: Box2D) -> bool:
    """Whether a box ends at a border of the region that is none of the image."""
    height_px, width_px = region.of.rgb.shape[:2]
    across = (box.x_min, box.x_max, region.x_px, region.x_px + region.width_px, width_px)
    along = (box.y_min, box.y_max, region.y_px, region.y_px + region.height_px, height_px)
    for low, high, first, last, length_px in (across, along):
        if (first > 0 and low < first - 0.5 + BORDER_PX) or (last < length_px and high > last - 0.5 - BORDER_PX):
            return True
    return False
