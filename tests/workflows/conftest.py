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
def copied(make_project: MakeProject, own_copy: Callable[[str], Path]) -> tuple[Path, Project]:
    """A copy of the generated people that a test may change, and its project of class person."""
    folder = own_copy("people")
    return folder, make_project(folder)


@pytest.fixture
def prepared(
    tmp_path: Path, made_once: Callable[[str, Callable[[Path], object]], Path], generated: Path
) -> Iterator[Callable[..., Project]]:
    """`prepared("drawn", fill, recording="people")`: a copy of a project that is made and filled once for all tests."""
    opened: list[Project] = []

    def copy(
        name: str, fill: Callable[[Project], object] | None = None, recording: str = "people", label: str = "person",
        rotation: BoxRotation = BoxRotation.AUTO,
    ) -> Project:  # fmt: skip
        def make(folder: Path) -> None:
            with create_project(folder, f"{name}0", (label,), settings=ProjectSettings(rotation=rotation)) as project:
                register_recording(project, open_recording(generated / recording))
                if fill is not None:
                    fill(project)

        made = made_once(f"prepared {name}", make) / f"{name}0"
        opened.append(open_project(Path(shutil.copytree(made, tmp_path / "projects" / made.name))))
        return opened[-1]

    yield copy
    for project in opened:
        project.close()


@pytest.fixture
def people(prepared: Callable[..., Project]) -> Project:
    """A project of class person with one recording of 5 unlabelled frames."""
    return prepared("project")


@pytest.fixture
def hands(prepared: Callable[..., Project]) -> Project:
    """Like `people`, for hands, whose boxes have free rotation."""
    return prepared("hands", recording="hands", label="hand", rotation=BoxRotation.FREE)
