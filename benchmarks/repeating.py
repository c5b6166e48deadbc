"""A recording that repeats a few generated frames, and a detector that knows them: length without cost."""

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
    """A detector that knows the first frames of a recording, for one that repeats them: `000007` is `000003` of 4."""

    first: Any
    different: int

    @property
    def labels(self) -> tuple[str, ...]:
        return (LABEL,)

    @property
    def fingerprint(self) -> str:
        return f"{self.first.fingerprint}-{self.different}"

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        known = [replace(i, key=_key(int(i.key) % self.different)) if isinstance(i, Frame) else i for i in images]
        found: list[list[Box2D]] = self.first.detect(known)
        return found


def knowing(source: Path, different: int) -> Repeating:
    """The detector for recordings that repeat the frames of `source`."""
    from annotator.detection.perfect import PerfectDetector, Scene
    from annotator.recordings import open_recording
    from annotator.workflows.truth import load_truth

    known = open_recording(source)
    frames = [known.frame(index) for index in range(different)]
    scenes = [Scene.of(frame, load_truth(known, index, frame)) for index, frame in enumerate(frames)]
    return Repeating(PerfectDetector(scenes), different)


def generate(folder: Path, different: int, width_px: int) -> None:
    """The frames that all recordings repeat."""
    from annotator.recordings.generated import write_generated

    write_generated(folder, PRESET, different, 0, width_px, width_px * 3 // 4)


def lengthen(source: Path, folder: Path, frames: int, different: int) -> None:
    """A recording of so many frames without so many files: its names are links to the source's files."""
    for name, suffix in FOLDERS.items():
        (folder / name).mkdir(parents=True)
        for number in range(frames):
            place = folder / name / (_key(number) + suffix)
            os.link(source / name / (_key(number % different) + suffix), place)
    for name in ("camera_intrinsic.json", "gravity.json"):
        os.link(source / name, folder / name)


def _key(number: int) -> str:
    return f"{number:06d}"
