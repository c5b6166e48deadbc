"""The registry of trained detectors."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from annotator.project import Project, StoredModel, open_project
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import ProjectError


def _register(project: Project, role: DetectorKind, name: str, activate: bool = True) -> StoredModel:
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


def _active(project: Project, role: DetectorKind) -> int:
    model = project.models.active(role)
    assert model is not None
    return model.id


def test_a_registered_model_is_read_back(project: Project) -> None:
    model = _register(project, DetectorKind.VIEW, "a")
    assert model.path == project.models_folder / "a" / "best.pt"
    assert model.manifest == project.models_folder / "a" / "manifest.json"
    assert (model.labels, model.box_kind, model.fingerprint) == (("hand", "person"), BoxKind.SILHOUETTE, "sha-a")
    assert model.metrics["map50"] == 0.9
    assert model.metrics["loss"] != model.metrics["loss"], "NaN is read back as NaN"
    assert project.models.get(model.id).path == model.path


def test_each_role_has_its_own_active_model(project: Project) -> None:
    assert project.models.active(DetectorKind.IMAGE) is None
    first = _register(project, DetectorKind.IMAGE, "a")
    second = _register(project, DetectorKind.IMAGE, "b")
    view = _register(project, DetectorKind.VIEW, "c")
    trial = _register(project, DetectorKind.IMAGE, "d", activate=False)

    assert [model.id for model in project.models.all(DetectorKind.IMAGE)] == [first.id, second.id, trial.id]
    assert _active(project, DetectorKind.IMAGE) == second.id
    assert _active(project, DetectorKind.VIEW) == view.id
    assert project.models.activate(first.id).active
    assert _active(project, DetectorKind.IMAGE) == first.id
    assert [model.active for model in project.models.all()] == [True, False, True, False]
    assert [model.id for model in project.models.all(DetectorKind.VIEW)] == [view.id]


def test_paths_of_models_inside_the_project_move_with_it(project: Project, tmp_path: Path) -> None:
    _register(project, DetectorKind.VIEW, "a")
    project.close()
    moved = project.path.rename(tmp_path / "moved")
    with open_project(moved) as reopened:
        paths = [model.path for model in reopened.models.all()]
    assert paths == [moved / "models" / "a" / "best.pt"]
    assert paths[0].is_file()


def test_models_lie_inside_the_project(project: Project, tmp_path: Path) -> None:
    outside = tmp_path / "outside.pt"
    outside.write_bytes(b"w")
    facts: dict[str, Any] = {"labels": [], "box_kind": BoxKind.BOX, "metrics": {}, "fingerprint": "f"}
    with pytest.raises(ProjectError, match=r"outside\.pt: lies outside .* copy it there"):
        project.models.register(DetectorKind.IMAGE, outside, **facts)
    _register(project, DetectorKind.VIEW, "a")
    project.close()
    for column, path in (("path", str(outside)), ("path", "../outside.pt"), ("manifest", "models/../../outside.pt")):
        with closing(sqlite3.connect(project.path / "project.db")) as database, database:
            database.execute("UPDATE models SET path = 'models/a/best.pt', manifest = NULL")
            database.execute(f"UPDATE models SET {column} = ?", [path])
        with pytest.raises(ProjectError, match=f"its view model 1 lies outside its folder, at {path}"):
            open_project(project.path)


def test_missing_files_and_models_are_named(project: Project, tmp_path: Path) -> None:
    with pytest.raises(ProjectError, match=r"none\.pt: is missing"):
        project.models.register(
            DetectorKind.IMAGE, tmp_path / "none.pt", labels=[], box_kind=BoxKind.BOX, metrics={}, fingerprint="f"
        )
    with pytest.raises(ProjectError, match="no model with id 5"):
        project.models.activate(5)
    assert project.models.all() == ()
