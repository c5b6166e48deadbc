"""Boxes for one live frame after the other, the last one's at hand."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from annotator.project.config import BoxRotation
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.rcv.propose import propose_from_boxes
from annotator.rcv.seeds import Seed
from annotator.types import Box2D, Detector, Frame, Image
from annotator.workflows.detectors import Detectors
from annotator.workflows.frames import orientation_for
from annotator.workflows.live.looking import Looking
from annotator.workflows.live.source import Taken

# Boxes of a frame that is longer ago than this say nothing of where an object is now, seconds.
OLDEST_SEED_S = 1.0


@dataclass(frozen=True, eq=False)
class Detected:
    """A frame with what was found on it.

    Attributes:
        taken_s: as of `Taken`.
        stages_s: what reading, both detectors and the geometry between them took, seconds.
        seeded: boxes of the last frame that were at hand.
        is_first: whether the detectors got ready on it, which takes longer.
    """

    frame: Frame
    found: FrameProposals
    taken_s: float
    stages_s: Mapping[str, float]
    seeded: int = 0
    is_first: bool = False

    @property
    def detect_s(self) -> float:
        """What all of the detection took, seconds."""
        return sum(seconds for stage, seconds in self.stages_s.items() if stage != "read")


def live_settings(config: RcvConfig) -> RcvConfig:
    """The settings as a live recursion has them: it ends with the wide step, unless they say otherwise themselves.

    The steps around the fit are a fifth of the views, more for what a picture cuts off, and gain little
    (docs/benchmarks.md).
    """
    if "refine_steps" in config.consensus.model_fields_set:
        return config
    return config.model_copy(update={"consensus": config.consensus.model_copy(update={"refine_steps": 0})})


class LiveDetection:
    """Recursive Cross-View on one frame at a time, by one thread."""

    def __init__(self, detectors: Detectors, config: RcvConfig, rotation: BoxRotation, *, warm_start: bool) -> None:
        """
        Args:
            config: its orientation and kind of boxes are set here, and what `live_settings` says.
            rotation: of the project; AUTO asks each frame whether it knows gravity.
            warm_start: begin each recursion with the box that the object had in the frame before.
        """
        self._image, self._view = _Timed(detectors.image), _Timed(detectors.view)
        self._looking = Looking(self._image)
        self._compute = detectors.compute
        self._config = live_settings(config).model_copy(update={"box_kind": detectors.box_kind})
        self._rotation = rotation
        self._warm_start = warm_start
        self._seeds: tuple[Seed, ...] = ()
        self._seeds_of_s = 0.0
        self._is_first = True

    @property
    def config(self) -> RcvConfig:
        """The settings in use; their orientation is that of the last frame."""
        return self._config

    def detect(self, taken: Taken) -> Detected:
        """The boxes of a frame."""
        begin = time.perf_counter()
        self._image.seconds = self._view.seconds = 0.0
        orientation = orientation_for(self._rotation, taken.frame)
        if self._config.orientation is not orientation:
            self._config = self._config.model_copy(update={"orientation": orientation})
        is_recent = abs(taken.taken_s - self._seeds_of_s) <= OLDEST_SEED_S
        seeds = self._seeds if self._warm_start and is_recent else ()
        if self._is_first and self._warm_start:
            self._looking.get_ready(taken.frame)
        boxes = self._looking.boxes(taken.frame, seeds, self._config)
        given = [seeds] if seeds else None
        (found,) = propose_from_boxes([taken.frame], [boxes], self._view, self._config, given, self._compute)
        if found.lost or len(found.proposals) < len(seeds):
            self._looking.lost()
        self._seeds = tuple(Seed(proposal.label, proposal.box) for proposal in found.proposals)
        self._seeds_of_s = taken.taken_s
        in_all = time.perf_counter() - begin
        image, view = self._image.seconds, self._view.seconds
        stages = {"read": taken.read_s, "image": image, "views": view, "geometry": in_all - image - view}
        is_first, self._is_first = self._is_first, False
        return Detected(taken.frame, found, taken.taken_s, stages, len(seeds), is_first)


class _Timed:
    """A detector that says how long it took."""

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
        found = self._detector.detect(images)
        self.seconds += time.perf_counter() - begin
        return found
