"""Detects 3D boxes in live frames, starting from the boxes of the previous frame."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from annotator.project.config import BoxRotation
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.rcv.propose import propose_from_boxes
from annotator.rcv.starts import WarmStart
from annotator.types import Box2D, Detector, Frame, Image
from annotator.workflows.detectors import Detectors
from annotator.workflows.frame_source import orientation_for
from annotator.workflows.live.detection_regions import RegionDetection
from annotator.workflows.live.source import Taken

# Maximum age of the boxes that a recursion starts from, seconds.
MAX_SEED_AGE_S = 1.0


@dataclass(frozen=True, eq=False)
class Detected:
    """A frame with its detected boxes.

    Attributes:
        found: the proposals.
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
    (docs/notebook/view_size.md).
    """
    if "refine_steps" in config.consensus.model_fields_set:
        return config
    return config.model_copy(update={"consensus": config.consensus.model_copy(update={"refine_steps": 0})})


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
        """Detects the boxes of a frame."""
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
        self._detector = detector
        self.seconds = 0.0

    @property
    def labels(self) -> tuple[str, ...]:
        return self._detector.labels

    @property
    def fingerprint(self) -> str:
        return self._detector.fingerprint

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        begin = time.perf_counter()
        boxes = self._detector.detect(images)
        self.seconds += time.perf_counter() - begin
        return boxes
