"""The registry of trained detectors."""

from __future__ import annotations

from pathlib import Path

import pytest

from annotator.project import Project, Role, StoredModel, open_project
from annotator.types import BoxKind
from annotator.types.errors import ProjectError


def _register(project: Project, role: Role, name: str, activate: bool = True) -> StoredModel:
    folder = project.models_folder / name
    folder.mkdir()
    (folder / "best.pt").write_bytes(name.encode())
    (folder / "manifest.json").write_text("{}")
    return project.models.register(
        role,
        folder / "best.pt",
        labels=["hand", "person"],
        box_kind=BoxKind.SILHOUETTE,
        metrics={"map50": 0.9, "loss": float("nan")},
        fingerprint=f"sha-{name}",
        manifest=folder / "manifest.json",
        activate=activate,
    )


def test_a_model_comes_back(project: Project) -> None:
    model = _register(project, Role.VIEW, "a")
    assert model.path == project.models_folder / "a" / "best.pt"
    assert model.manifest == project.models_folder / "a" / "manifest.json"
    assert (model.labels, model.box_kind, model.fingerprint) == (("hand", "person"), BoxKind.SILHOUETTE, "sha-a")
    assert model.metrics["map50"] == 0.9
    assert model.metrics["loss"] != model.metrics["loss"], "not a number comes back as such"
    assert project.models.get(model.id).path == model.path


def test_each_role_has_its_own_latest_and_active_model(project: Project) -> None:
    assert project.models.latest(Role.IMAGE) is None
    assert project.models.active(Role.IMAGE) is None
    first = _register(project, Role.IMAGE, "a")
    second = _register(project, Role.IMAGE, "b")
    view = _register(project, Role.VIEW, "c")
    trial = _register(project, Role.IMAGE, "d", activate=False)

    def ids(role: Role) -> tuple[int, int]:
        latest, active = project.models.latest(role), project.models.active(role)
        assert latest is not None
        assert active is not None
        return latest.id, active.id

    assert ids(Role.IMAGE) == (trial.id, second.id)
    assert ids(Role.VIEW) == (view.id, view.id)
    assert project.models.activate(first.id).active
    assert ids(Role.IMAGE) == (trial.id, first.id)
    assert [model.active for model in project.models.all()] == [True, False, True, False]
    assert [model.id for model in project.models.all(Role.VIEW)] == [view.id]


def test_models_move_with_the_project_and_others_stay(project: Project, tmp_path: Path) -> None:
    _register(project, Role.VIEW, "a")
    outside = tmp_path / "outside.pt"
    outside.write_bytes(b"w")
    project.models.register(Role.IMAGE, outside, labels=[], box_kind=BoxKind.BOX, metrics={}, fingerprint="f")
    project.close()
    moved = project.path.rename(tmp_path / "moved")
    with open_project(moved) as found:
        paths = [model.path for model in found.models.all()]
    assert paths == [moved / "models" / "a" / "best.pt", outside]
    assert all(path.is_file() for path in paths)


def test_missing_files_and_models_are_named(project: Project, tmp_path: Path) -> None:
    with pytest.raises(ProjectError, match=r"none\.pt: is missing"):
        project.models.register(
            Role.IMAGE, tmp_path / "none.pt", labels=[], box_kind=BoxKind.BOX, metrics={}, fingerprint="f"
        )
    with pytest.raises(ProjectError, match="no model with id 5"):
        project.models.activate(5)
    assert project.models.all() == ()
