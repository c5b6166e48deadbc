"""True boxes of the generated people, and a project to be copied."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from threading import Lock

import pytest
from true_room import Room

from annotator.project import Project, create_project
from annotator.recordings import open_recording
from annotator.types import BoxKind, Truth
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import Detectors
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.workbench.loaded_detectors import ReadyDetector


@pytest.fixture(scope="module")
def truths(generated: Path) -> list[list[Truth]]:
    """Three people in each of five frames, in one order."""
    recording = open_recording(generated / "people")
    return [list(load_truth(recording, index, recording.frame(index))) for index in range(5)]


@pytest.fixture
def empty(generated: Path, tmp_path: Path) -> Path:
    """A closed project with a recording of 5 frames, to be copied."""
    with closing(create_project(tmp_path, "empty", ("person", "chair"))) as project:
        register_recording(project, open_recording(generated / "people"))
        return project.path


@pytest.fixture
def room(people: Project, truths: list[list[Truth]], knowing: Callable[..., Detectors]) -> Room:
    return Room(people, truths, ReadyDetector(knowing("people").view, BoxKind.BOX, Lock()))
