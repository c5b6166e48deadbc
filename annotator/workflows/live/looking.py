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

# The whole image is looked at every so many frames; and for as many where regions were looked at in vain.
WHOLE_EVERY = 5
# A region is at least so many times as large as its object was, which has moved; where that is not enough, the whole
# image is looked at.
ROOM = 1.3
# Sides of regions are so many parts of the image's longer side, and no less than three: networks compute whole steps of
# 32 px, and look at an image with 256 unless they were trained at another size.
PARTS, LEAST_PARTS = 8, 3
# Regions that make up more of the image than this share save little.
MOST_SHARE = 0.6
# An edge this near to the border of a region, pixels of the image, may lie beyond it.
BORDER_PX = 2.0
# Two boxes of a class that overlap more may be one object, found twice.
SAME_IOU = 0.5


class Looking:
    """Boxes on the images of one frame after the other, the last one's objects at hand."""

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self._follow = 0  # frames before the whole image is looked at again
        self._rest = 0  # whole looks before objects are followed again

    def get_ready(self, frame: Frame) -> None:
        """Asks for each kind of region that may be looked at: networks make themselves ready for each when it first
        comes, which takes as long as a dozen frames."""
        for parts, count in itertools.product(range(LEAST_PARTS, PARTS + 1), (1, 2)):
            regions = [_square(frame, (0.0, 0.0), parts)] * count
            if _is_worth_it(frame, regions):
                self._detector.detect(regions)

    def boxes(self, frame: Frame, seeds: Sequence[Seed], config: RcvConfig) -> list[Box2D]:
        """The boxes on a frame's image.

        Args:
            seeds: the objects that were there a moment ago; without any the whole image is looked at.
        """
        regions = self._regions(frame, seeds) if self._follow > 0 and self._rest == 0 else None
        if regions:
            found = self._followed(regions, config)
            if found is not None:
                self._follow -= 1
                return found
            self._rest = WHOLE_EVERY
        self._follow, self._rest = WHOLE_EVERY - 1, max(self._rest - 1, 0)
        (whole,) = self._detector.detect([frame])
        return whole

    def lost(self) -> None:
        """Something that was seen, or followed, has no box: the next look is at the whole image."""
        self._follow = 0

    def _regions(self, frame: Frame, seeds: Sequence[Seed]) -> list[tuple[Box2D, Region]] | None:
        """Where each object was on the image, and the region around it; None where that is no good."""
        outlines = [box_on_image(frame.camera, seed.box, seed.label) for seed in seeds]
        known = [outline for outline in outlines if outline is not None]
        regions = regions_around(frame, known)
        if len(known) < len(seeds) or not _is_worth_it(frame, regions):
            return None
        return list(zip(known, regions, strict=True))

    def _followed(self, regions: Sequence[tuple[Box2D, Region]], config: RcvConfig) -> list[Box2D] | None:
        """One box an object; None where one of them is not there, or two may be the same."""
        found: list[Box2D] = []
        answers = self._detector.detect([region for _, region in regions])
        for (outline, region), boxes in zip(regions, answers, strict=True):
            box = _same_object(outline, region, boxes, config)
            if box is None:
                return None
            found.append(box)
        pairs = itertools.combinations(found, 2)
        return None if any(a.label == b.label and box_iou(a, b) > SAME_IOU for a, b in pairs) else found


def regions_around(frame: Frame, boxes: Sequence[Box2D]) -> list[Region]:
    """The parts of a frame's image around some boxes, all of one size: networks get ready for each."""
    part_px = max(frame.rgb.shape[:2]) / PARTS
    longest_px = max((max(box.width_px, box.height_px) for box in boxes), default=0.0)
    parts = max(math.ceil(ROOM * longest_px / part_px), LEAST_PARTS)
    return [_square(frame, ((box.x_min + box.x_max) / 2, (box.y_min + box.y_max) / 2), parts) for box in boxes]


def _square(frame: Frame, middle: tuple[float, float], parts: int) -> Region:
    """A square so many parts long, as far as the image is as large, with its middle as near as can be."""
    height_px, width_px = frame.rgb.shape[:2]
    side_px = round(parts * max(height_px, width_px) / PARTS)
    width, height = min(side_px, width_px), min(side_px, height_px)
    x = min(max(round(middle[0] - width / 2), 0), width_px - width)
    y = min(max(round(middle[1] - height / 2), 0), height_px - height)
    return Region(frame, x, y, width, height)


def _is_worth_it(frame: Frame, regions: Sequence[Region]) -> bool:
    height_px, width_px = frame.rgb.shape[:2]
    return sum(region.width_px * region.height_px for region in regions) <= MOST_SHARE * height_px * width_px


def _same_object(outline: Box2D, region: Region, boxes: Sequence[Box2D], config: RcvConfig) -> Box2D | None:
    """The box, on the whole image, that is most likely where the object is now."""
    on_image = [
        box.shifted(region.x_px, region.y_px)
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
