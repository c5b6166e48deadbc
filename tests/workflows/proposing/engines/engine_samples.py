"""Detectors for tests of engines, loaded by worker processes, which kill their process or delay calls."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from annotator.detection.config import DetectorConfig
from annotator.detection.yolo import YoloDetector
from annotator.project import Project
from annotator.rcv.config import RcvConfig
from annotator.types import Box2D, Detector, Frame, Image
from annotator.types.errors import DetectionError
from annotator.workflows.detectors import Detectors

CONFIG = RcvConfig(max_steps=1)


def stored(project: Project) -> list[str]:
    """The latest proposals as one string per frame; equal strings mean bitwise equal results."""
    found = []
    for frame in project.frames.of():
        labels = project.labels.of_moment(frame.id)
        found.append(
            repr(
                [(o.label.label, o.label.score, o.label.box.pose.tolist(), o.label.box.size_m.tolist()) for o in labels]
            )
            + repr([o.quality for o in labels])
        )
    return found


@dataclass(frozen=True, eq=False)
class Harmful:
    """Forwards to another detector, and kills its process on some frames.

    Attributes:
        deadly: keys of the frames on which the process is killed.
        once: a file; the process is killed only if it is missing, and creates it before.
        slow_s: delay of each call, seconds.
        told: a folder in which each working process creates a file named by its id.
    """

    inner: Detector
    deadly: tuple[str, ...] = ()
    once: Path | None = None
    slow_s: float = 0.0
    told: Path | None = None

    @property
    def labels(self) -> tuple[str, ...]:
        return self.inner.labels

    @property
    def fingerprint(self) -> str:
        return self.inner.fingerprint

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        if self.told is not None:
            (self.told / str(os.getpid())).touch()
        time.sleep(self.slow_s)
        keys = {image.key for image in images if isinstance(image, Frame)}
        if keys & set(self.deadly) and not (self.once is not None and self.once.exists()):
            if self.once is not None:
                self.once.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return self.inner.detect(images)


class HarmfulPair:
    """A source with a `Harmful` image detector."""

    def __init__(self, inner: Detectors, **harm: Any) -> None:
        self.inner, self.harm = inner, harm

    def load(self, threads: int | None) -> Detectors:
        return Detectors(Harmful(self.inner.image, **self.harm), self.inner.view, self.inner.box_kind)


@dataclass(frozen=True, eq=False)
class RealViews:
    """A source with a real network for the views; the low confidence threshold accepts all its boxes."""

    inner: Detectors
    weights: Path

    def load(self, threads: int | None) -> Detectors:
        config = DetectorConfig(image_size_px=64, confidence=1e-4, device="cpu", backend="torch", threads=threads)
        return Detectors(self.inner.image, YoloDetector(self.weights, config), self.inner.box_kind)


@dataclass(frozen=True)
class Unloadable:
    """A source that fails like a damaged weights file."""

    def load(self, threads: int | None) -> Detectors:
        raise DetectionError("weights.pt: cannot be read as detector weights")
