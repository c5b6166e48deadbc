"""What both demos share: the generated recording, its project, and the duration of each stage."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

from annotator.project import BoxRotation, Project, ProjectSettings, create_project
from annotator.recordings import open_recording
from annotator.synthetic import write_generated
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import register_recording

RECORDING, PROJECT = "recording", "demo"
LABELS = {"people": "person", "hands": "hand", "objects": "object"}
# People and objects stand upright; hands may be turned in any way.
ROTATIONS = {"people": BoxRotation.UPRIGHT, "hands": BoxRotation.FREE, "objects": BoxRotation.UPRIGHT}

Progress = Callable[[str, float, float], None]
"""Called with (stage, amount done, total amount)."""


@dataclass
class Stopwatch:
    """The duration of each stage, seconds, by name."""

    seconds: dict[str, float] = field(default_factory=dict)
    _begin: float = field(default_factory=time.perf_counter)

    def end(self, stage: str) -> None:
        """Ends a stage, and begins the next."""
        now = time.perf_counter()
        self.seconds[stage] = now - self._begin
        self._begin = now


def counted(progress: Progress, stage: str) -> Callable[[int, int], None]:
    """The progress of a stage whose steps are counted."""
    return lambda done, total: progress(stage, float(done), float(total))


def dataset_folder(root: Path, preset: str) -> Path:
    """The folder of the demo's dataset."""
    return root / f"3D_{LABELS.get(preset, preset).upper()}"


def require_free(root: Path, preset: str) -> None:
    """Checks that the demo overwrites nothing, before minutes of work.

    Raises:
        ConfigError: a file or folder of the demo exists.
    """
    for path in (root / RECORDING, root / PROJECT, dataset_folder(root, preset)):
        if path.exists():
            raise ConfigError(f"{path}: exists already; choose another folder for the demo")


def generate(root: Path, preset: str, frames: int, seed: int, progress: Progress) -> None:
    """Writes the recording.

    Raises:
        ConfigError: unknown preset.
    """
    write_generated(root / RECORDING, preset, frames, seed, report=counted(progress, "ray-cast the recording"))


def new_project(root: Path, preset: str) -> AbstractContextManager[Project]:
    """Creates the project of a recording."""
    return create_project(root, PROJECT, (LABELS[preset],), settings=ProjectSettings(rotation=ROTATIONS[preset]))


def add_recording(project: Project, root: Path) -> int:
    """Adds the recording to the project, without its labels; returns its id."""
    return register_recording(project, open_recording(root / RECORDING)).id
