"""Projects with small generated recordings."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from annotator.project import BoxRotation, Project, ProjectSettings, create_project, open_project
from annotator.recordings import open_recording
from annotator.workflows.add_recordings import register_recording

MakeProject = Callable[..., Project]
CopyProject = Callable[[Path], Project]


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
        made.append(create_project(tmp_path / "projects", f"project{len(made) + 1}", classes, settings=settings))
        for path in recordings:
            register_recording(made[-1], open_recording(path), up=up)
        return made[-1]

    yield make
    for project in made:
        project.close()


@pytest.fixture
def copy_project(tmp_path: Path) -> Iterator[CopyProject]:
    """A copy of a closed project, which is made once: `copy_project(made_once(NAME, fill) / "project0")`."""
    made: list[Project] = []

    def copy(template: Path) -> Project:
        made.append(open_project(Path(shutil.copytree(template, tmp_path / "projects" / template.name))))
        return made[-1]

    yield copy
    for project in made:
        project.close()


@pytest.fixture
def people(
    copy_project: CopyProject, made_once: Callable[[str, Callable[[Path], object]], Path], generated: Path
) -> Project:
    """A project of class person with one recording of 5 unlabelled frames."""

    def fill(folder: Path) -> None:
        with create_project(folder, "project0", ("person",)) as project:
            register_recording(project, open_recording(generated / "people"))

    return copy_project(made_once("people project", fill) / "project0")


@pytest.fixture
def hands(
    copy_project: CopyProject, made_once: Callable[[str, Callable[[Path], object]], Path], generated: Path
) -> Project:
    """Like `people`, for hands, whose boxes have free rotation."""

    def fill(folder: Path) -> None:
        settings = ProjectSettings(rotation=BoxRotation.FREE)
        with create_project(folder, "hands0", ("hand",), settings=settings) as project:
            register_recording(project, open_recording(generated / "hands"))

    return copy_project(made_once("hands project", fill) / "hands0")
