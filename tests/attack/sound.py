"""What must hold for a project after any attack."""

from __future__ import annotations

from pathlib import Path

from store_samples import state_of

from annotator.cli.main import main
from annotator.project import Project, open_project

Labels = dict[str, list[tuple[str, str, tuple[float, ...]]]]
"""By frame: class, state and centre (rounded to micrometres) of each label, sorted."""


def require_sound(path: Path) -> None:
    """`verify --deep` finds nothing; the project opens with its detectors, and its events rebuild to what is stored."""
    assert main(["project", "verify", path.name, "--deep", "--projects", str(path.parent)]) == 0, path
    with open_project(path) as project:
        assert project.problems() == []
        stored = state_of(project)
        project.log.rebuild()
        assert state_of(project) == stored
        for model in project.models.all():
            assert model.path.is_file(), model
            assert model.manifest is None or model.manifest.is_file(), model


def labels_in(path: Path) -> Labels:
    """The labels of a project."""
    with open_project(path) as project:
        return {frame.key: _labels(project, frame.id) for frame in project.frames.of()}


def _labels(project: Project, frame: int) -> list[tuple[str, str, tuple[float, ...]]]:
    found = project.labels.of_frame(frame)
    return sorted((each.label, each.state.value, tuple(each.box.center_m.round(6).tolist())) for each in found)


def content_of(folder: Path) -> dict[str, bytes]:
    """All files of a folder, by relative path."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}
