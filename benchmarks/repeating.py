"""Long recordings in little time: a recording that repeats a few generated frames, and a perfect detector for it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from annotator.types import Box2D, Frame, Image

PRESET, LABEL = "people", "person"
FOLDERS = {"color": ".jpg", "depth": ".png"}


@dataclass(frozen=True)
class Repeating:
    """A perfect detector for a recording that repeats its first frames; with 4, `000007` is the same as `000003`.

    Attributes:
        first: perfect detector of the first frames.
        different: number of the first frames.
    """

    first: Any
    different: int

    @property
    def labels(self) -> tuple[str, ...]:
        return (LABEL,)

    @property
    def fingerprint(self) -> str:
        return f"{self.first.fingerprint}-{self.different}"

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        originals = [replace(i, key=_key(int(i.key) % self.different)) if isinstance(i, Frame) else i for i in images]
        boxes: list[list[Box2D]] = self.first.detect(originals)
        return boxes


def perfect_detector(source: Path, different: int) -> Repeating:
    """The perfect detector for recordings that repeat the frames of `source`."""
    from annotator.detection.perfect import PerfectDetector, Scene
    from annotator.recordings import open_recording
    from annotator.workflows.recorded.reading import load_truth

    recording = open_recording(source)
    frames = [recording.frame(index) for index in range(different)]
    scenes = [Scene.of(frame, load_truth(recording, index, frame)) for index, frame in enumerate(frames)]
    return Repeating(PerfectDetector(scenes), different)


def generate(folder: Path, different: int, width_px: int) -> None:
    """Generates the frames that all recordings repeat."""
    from annotator.synthetic import write_generated

    write_generated(folder, PRESET, different, 0, width_px, width_px * 3 // 4)


def lengthen(source: Path, folder: Path, frames: int, different: int) -> None:
    """Creates a recording of `frames` frames as hard links to the files of the source's frames."""
    for name, suffix in FOLDERS.items():
        (folder / name).mkdir(parents=True)
        for number in range(frames):
            link = folder / name / (_key(number) + suffix)
            os.link(source / name / (_key(number % different) + suffix), link)
    for name in ("camera_intrinsic.json", "gravity.json"):
        os.link(source / name, folder / name)


def _key(number: int) -> str:
    return f"{number:06d}"
