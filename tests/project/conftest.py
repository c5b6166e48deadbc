"""Fixtures: a new project with one recording."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from annotator.project import Project, StoredRecording, create_project


@pytest.fixture
def project(tmp_path: Path) -> Iterator[Project]:
    with create_project(tmp_path, "hands", ("hand", "person")) as project:
        yield project


@pytest.fixture
def recording(project: Project, tmp_path: Path) -> StoredRecording:
    """Five frames, "0" to "4"."""
    return project.recordings.add(tmp_path / "take", "rgbd", "take", [str(n) for n in range(5)], True)


@pytest.fixture
def frame(project: Project, recording: StoredRecording) -> int:
    """The id of an unlabelled frame."""
    return project.frames.find(recording.id, "2").id
