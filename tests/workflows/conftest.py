"""Projects with small generated recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from annotator.project import BoxRotation, Project, ProjectSettings, create_project
from annotator.recordings import open_recording
from annotator.workflows.add_recordings import register_recording

MakeProject = Callable[..., Project]


@pytest.fixture
def make_project(tmp_path: Path) -> Iterator[MakeProject]:
    """Creates projects: `make_project(path, ..., classes=("person",), rotation=BoxRotation.AUTO)`."""
    made: list[Project] = []

    def make(
        *recordings: Path,
        classes: Sequence[str] = ("person",),
        rotation: BoxRotation = BoxRotation.AUTO,
        up: Sequence[float] | None = None,
    ) -> Project:
        settings = ProjectSettings(rotation=rotation)
        made.append(create_project(tmp_path / "projects", f"project{len(made)}", classes, settings=settings))
        for path in recordings:
            register_recording(made[-1], open_recording(path), up=up)
        return made[-1]

    yield make
    for project in made:
        project.close()


@pytest.fixture
def people(make_project: MakeProject, generated: Path) -> Project:
    """A project of class person with one recording of 5 unlabelled frames."""
    return make_project(generated / "people")


@pytest.fixture
def hands(make_project: MakeProject, generated: Path) -> Project:
    """Like `people`, for hands, whose boxes have free rotation."""
    return make_project(generated / "hands", classes=("hand",), rotation=BoxRotation.FREE)
