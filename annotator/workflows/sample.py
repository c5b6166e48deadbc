"""A sample to try the page with: a generated recording of people in a room, beside the projects."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from annotator.files import private_folder
from annotator.project import BoxRotation, Project, ProjectSettings, create_project
from annotator.recordings import open_recording
from annotator.synthetic import write_generated
from annotator.workflows.add_recordings import register_recording

# Within the projects folder; hidden, thus not a project. All samples share the recording.
SAMPLES, RECORDING = ".samples", "people"
NAME, CLASSES = "sample", ("person",)
# Enough to follow somebody, and generated in some seconds.
FRAMES, SEED = 16, 0


def create_sample(root: Path) -> Path:
    """Creates an empty project for the sample in a projects folder, under a free name; returns its folder."""
    number, name = 1, NAME
    while (root / name).exists():
        number += 1
        name = f"{NAME}-{number}"
    settings = ProjectSettings(rotation=BoxRotation.UPRIGHT)
    with create_project(root, name, CLASSES, settings=settings) as project:
        return project.path


def is_generated(root: Path) -> bool:
    """Whether an earlier sample of a projects folder has generated the recording."""
    return (root / SAMPLES / RECORDING).is_dir()


def add_sample(project: Project, progress: Callable[[int, int], None] | None = None) -> int:
    """Adds the generated recording to a project; returns the number of frames.

    Args:
        progress: called with (frames generated, frames); not if the recording is there already.
    """
    place = project.path.parent / SAMPLES / RECORDING
    if not is_generated(project.path.parent):
        private_folder(place.parent)
        write_generated(place, "people", FRAMES, SEED, report=progress)
    return register_recording(project, open_recording(place)).frames
