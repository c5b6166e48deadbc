"""Detects 3D boxes in live frames, starting from the boxes of the previous frame.

A network takes as long for one camera image as for a dozen pseudo-views. While objects are followed, regions around
them are enough. The whole image is used every few frames, and whenever an object is not found in its region.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from annotator.geometry.iou import box_iou
from annotator.geometry.outline import box_on_image
from annotator.project.config import BoxRotation
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.rcv.propose import propose_from_boxes
from annotator.rcv.starts import MIN_IMAGE_IOU, WarmStart
from annotator.types import Box2D, Detector, Frame, Image, Region
from annotator.workflows.detectors import Detectors
from annotator.workflows.frame_source import orientation_for

# The whole image is used once in this many frames, and for this many frames after an object was lost in its region.
WHOLE_EVERY = 5
# Minimum ratio of a region's side to its object's, which may have moved.
REGION_FACTOR = 1.3
# The sides of regions are multiples of 1/8 of the image's longer side, at least 3/8: networks work in steps of 32 px,
# and scale images to 256 px unless they were trained at another size.
PARTS, MIN_PARTS = 8, 3
# Maximum share of the image covered by regions; larger ones save little time.
MAX_SHARE = 0.6
# A box edge this near to the border of its region may be cut off there, pixels of the image.
BORDER_PX = 2.0
# 2D IoU above which two boxes of a class may be the same object.
SAME_IOU = 0.5


class RegionDetection:
    """Detects boxes on the images of successive frames, in regions around the previous frame's objects if possible."""

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self._region_frames = 0  # frames left before the whole image is used again
        self._whole_frames = 0  # frames left before regions are used again

    def prepare(self, frame: Frame) -> None:
        """Runs the detector once on each possible size and number of regions.

        Networks need extra time, as long as a dozen frames, for the first input of each shape.
        """
        for parts, count in itertools.product(range(MIN_PARTS, PARTS + 1), (1, 2)):
            regions = [_square(frame, (0.0, 0.0), parts)] * count
            if _save_time(frame, regions):
                self._detector.detect(regions)

    def boxes(self, frame: Frame, seeds: Sequence[WarmStart], config: RcvConfig) -> list[Box2D]:
        """Detects the boxes on a frame's image.

        Args:
            seeds: the objects of the previous frame; without any, the whole image is used.
        """
        regions = self._regions(frame, seeds) if self._region_frames > 0 and self._whole_frames == 0 else None
        if regions:
            followed = self._followed(regions, config)
            if followed is not None:
                self._region_frames -= 1
                return followed
            self._whole_frames = WHOLE_EVERY
        self._region_frames, self._whole_frames = WHOLE_EVERY - 1, max(self._whole_frames - 1, 0)
        (whole,) = self._detector.detect([frame])
        return whole

    def lost(self) -> None:
        """Uses the whole image for the next frame, because an object got no 3D box."""
        self._region_frames = 0

    def _regions(self, frame: Frame, seeds: Sequence[WarmStart]) -> list[tuple[Box2D, Region]] | None:
        """Returns each object's outline on the image and the region around it; None if regions cannot be used."""
        outlines = [box_on_image(frame.camera, seed.box, seed.label) for seed in seeds]
        visible = [outline for outline in outlines if outline is not None]
        regions = regions_around(frame, visible)
        if len(visible) < len(seeds) or not _save_time(frame, regions):
            return None
        return list(zip(visible, regions, strict=True))

    def _followed(self, regions: Sequence[tuple[Box2D, Region]], config: RcvConfig) -> list[Box2D] | None:
        """Returns one box per object; None if one is not found, or two may be the same object."""
        followed: list[Box2D] = []
        boxes_by_region = self._detector.detect([region for _, region in regions])
        for (outline, region), boxes in zip(regions, boxes_by_region, strict=True):
            box = _same_object(outline, region, boxes, config)
            if box is None:
                return None
            followed.append(box)
        pairs = itertools.combinations(followed, 2)
        return None if any(a.label == b.label and box_iou(a, b) > SAME_IOU for a, b in pairs) else followed


def regions_around(frame: Frame, boxes: Sequence[Box2D]) -> list[Region]:
    """Returns the regions of a frame's image around some boxes, all of one size, so that they fit one batch."""
    part_px = max(frame.rgb.shape[:2]) / PARTS
    longest_px = max((max(box.width_px, box.height_px) for box in boxes), default=0.0)
    parts = max(math.ceil(REGION_FACTOR * longest_px / part_px), MIN_PARTS)
    return [_square(frame, ((box.x_min + box.x_max) / 2, (box.y_min + box.y_max) / 2), parts) for box in boxes]


def _square(frame: Frame, center: tuple[float, float], parts: int) -> Region:
    """Returns the square region nearest to a centre, clipped to the image; `parts` is its side in 1/8 of the image."""
    height_px, width_px = frame.rgb.shape[:2]
    side_px = round(parts * max(height_px, width_px) / PARTS)
    width, height = min(side_px, width_px), min(side_px, height_px)
    x = min(max(round(center[0] - width / 2), 0), width_px - width)
    y = min(max(round(center[1] - height / 2), 0), height_px - height)
    return Region(frame, x, y, width, height)


def _save_time(frame: Frame, regions: Sequence[Region]) -> bool:
    height_px, width_px = frame.rgb.shape[:2]
    return sum(region.width_px * region.height_px for region in regions) <= MAX_SHARE * height_px * width_px


def _same_object(outline: Box2D, region: Region, boxes: Sequence[Box2D], config: RcvConfig) -> Box2D | None:
    """Returns the box of the same class that overlaps the outline most, in image pixels; None if none fits."""
    on_image = [
        box.shifted(region.x_px, region.y_px)
        for box in boxes
        if box.label == outline.label and box.score >= config.min_image_score
    ]
    best = max(on_image, key=lambda box: box_iou(box, outline), default=None)
    if best is None or box_iou(best, outline) < MIN_IMAGE_IOU or _is_cut(region, best):
        return None
    return best


def _is_cut(region: Region, box: Box2D) -> bool:
    """Returns True if a box touches a border of the region that is not a border of the image."""
    height_px, width_px = region.of.rgb.shape[:2]
    across = (box.x_min, box.x_max, region.x_px, region.x_px + region.width_px, width_px)
    along = (box.y_min, box.y_max, region.y_px, region.y_px + region.height_px, height_px)
    for low, high, first, last, length_px in (across, along):
        if (first > 0 and low < first - 0.5 + BORDER_PX) or (last < length_px and high > last - 0.5 - BORDER_PX):
            return True
    return False


# Maximum age of the boxes that a recursion starts from, seconds.
MAX_SEED_AGE_S = 1.0


@dataclass(frozen=True, eq=False)
class Taken:
    """A frame from a source.

    Attributes:
        taken_s: when the camera took it, or when it was due in playback; `time.perf_counter`.
        read_s: time to read it, seconds.
    """

    frame: Frame
    taken_s: float
    read_s: float


@dataclass(frozen=True, eq=False)
class Detected:
    """A frame with its detected boxes.

    Attributes:
        taken_s: as in `Taken`.
        stages_s: durations of reading, both detectors and the geometry between them, seconds.
        seeded: number of boxes of the previous frame that the recursion started from.
        is_first: True for the first frame, which takes longer because the detectors are prepared.
    """

    frame: Frame
    found: FrameProposals
    taken_s: float
    stages_s: Mapping[str, float]
    seeded: int = 0
    is_first: bool = False

    @property
    def detect_s(self) -> float:
        """Duration of the detection, seconds."""
        return sum(seconds for stage, seconds in self.stages_s.items() if stage != "read")


def live_settings(config: RcvConfig) -> RcvConfig:
    """Returns the settings for live recursion: no refinement steps, unless the settings set their number.

    Refinement steps are a fifth of the views, more for objects cut off by the image border, and gain little
    (docs/notebook.md).
    """
    if "refine_steps" in config.model_fields_set:
        return config
    return config.model_copy(update={"refine_steps": 0})


class LiveDetection:
    """Recursive Cross-View on one frame at a time, by one thread."""

    def __init__(self, detectors: Detectors, config: RcvConfig, rotation: BoxRotation, *, warm_start: bool) -> None:
        """
        Args:
            config: its orientation and box kind are set here, and the changes of `live_settings` applied.
            rotation: of the project; AUTO depends on the frame's up direction.
            warm_start: start each recursion from the object's box in the previous frame.
        """
        self._image, self._view = _Timed(detectors.image), _Timed(detectors.view)
        self._regions = RegionDetection(self._image)
        self._config = live_settings(detectors.settings(config))
        self._rotation = rotation
        self._warm_start = warm_start
        self._seeds: tuple[WarmStart, ...] = ()
        self._seeds_of_s = 0.0
        self._is_first = True

    @property
    def config(self) -> RcvConfig:
        """The settings in use, with the orientation of the last frame."""
        return self._config

    def detect(self, taken: Taken) -> Detected:
        begin = time.perf_counter()
        self._image.seconds = self._view.seconds = 0.0
        orientation = orientation_for(self._rotation, taken.frame)
        if self._config.orientation is not orientation:
            self._config = self._config.model_copy(update={"orientation": orientation})
        is_recent = abs(taken.taken_s - self._seeds_of_s) <= MAX_SEED_AGE_S
        seeds = self._seeds if self._warm_start and is_recent else ()
        if self._is_first and self._warm_start:
            self._regions.prepare(taken.frame)
        boxes = self._regions.boxes(taken.frame, seeds, self._config)
        frame_seeds = [seeds] if seeds else None
        (result,) = propose_from_boxes([taken.frame], [boxes], self._view, self._config, frame_seeds)
        if result.lost or len(result.proposals) < len(seeds):
            self._regions.lost()
        self._seeds = tuple(WarmStart(proposal.label, proposal.box) for proposal in result.proposals)
        self._seeds_of_s = taken.taken_s
        total_s = time.perf_counter() - begin
        image, view = self._image.seconds, self._view.seconds
        stages = {"read": taken.read_s, "image": image, "views": view, "geometry": total_s - image - view}
        is_first, self._is_first = self._is_first, False
        return Detected(taken.frame, result, taken.taken_s, stages, len(seeds), is_first)


class _Timed:
    """A detector that adds up its run time."""

    def __init__(self, detector: Detector) -> None:
        self._detector, self.labels, self.fingerprint = detector, detector.labels, detector.fingerprint
        self.seconds = 0.0

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        begin = time.perf_counter()
        boxes = self._detector.detect(images)
        self.seconds += time.perf_counter() - begin
        return boxes
