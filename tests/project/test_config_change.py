"""Changes of classes that end in the middle, and whoever has a project open while its folder is renamed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from annotator.files import lock_folder
from annotator.project import Project, config, create_project, open_project
from annotator.project.classes import edit
from annotator.project.config import not_in_use, read_config, rename_project
from annotator.types.errors import InUseError


@pytest.fixture
def cars(tmp_path: Path) -> Path:
    with create_project(tmp_path, "cars", ("car",)):
        return tmp_path / "cars"


def to_lorry(project: Project) -> None:
    project.change_classes(lambda config: edit.rename_class(config, "car", "lorry"), "ann")


def test_a_kill_after_the_transaction_has_ended_leaves_the_new_classes(cars: Path, monkeypatch) -> None:
    taken = config.take_config

    def killed(folder: Path, connection: object) -> object:
        if any(folder.glob("project.json.event-*")):
            raise KeyboardInterrupt
        return taken(folder, connection)

    with monkeypatch.context() as patched, open_project(cars) as project, pytest.raises(KeyboardInterrupt):
        patched.setattr("annotator.project.project.take_config", killed)
        to_lorry(project)
    assert read_config(cars).classes == ("car",)
    with open_project(cars) as project:
        assert project.config.classes == ("lorry",)
    assert not list(cars.glob("project.json.*"))


def test_a_kill_before_the_transaction_has_ended_leaves_the_old_classes(cars: Path, monkeypatch) -> None:
    def killed(folder: Path, config: object, connection: object) -> Path:
        path = prepare(folder, config, connection)
        kept.append((path, path.read_bytes()))
        raise KeyboardInterrupt

    prepare, kept = config.prepare_config, list[tuple[Path, bytes]]()
    with monkeypatch.context() as patched, open_project(cars) as project, pytest.raises(KeyboardInterrupt):
        patched.setattr("annotator.project.project.prepare_config", killed)
        to_lorry(project)
    ((path, content),) = kept
    path.write_bytes(content)
    with open_project(cars) as project:
        assert project.config.classes == ("car",) and not path.exists()
        # another event with the number of the one that was lost
        project.change_classes(lambda config: edit.add_class(config, "van"), "ann")
        path.write_bytes(content)
    with open_project(cars) as project:
        assert project.config.classes == ("car", "van") and not path.exists()


def test_a_rename_keeps_what_was_changed_just_before(cars: Path, monkeypatch) -> None:
    class Late:
        def __init__(self, folder: Path) -> None:
            with open_project(folder) as project:
                to_lorry(project)

        def __enter__(self) -> None: ...

        def __exit__(self, *_: object) -> None: ...

    monkeypatch.setattr("annotator.project.config.not_in_use", Late)
    rename_project(cars, "lorries")
    config = read_config(cars.parent / "lorries")
    assert (config.name, config.classes) == ("lorries", ("lorry",))


def test_two_cannot_rename_at_once(cars: Path) -> None:
    lock = lock_folder(cars)
    assert lock is not None
    try:
        with pytest.raises(InUseError, match="another process has this project open"), not_in_use(cars):
            pass
    finally:
        os.close(lock)
    with not_in_use(cars):
        pass


def test_a_model_knows_renames_since_its_labels_were_read(cars: Path) -> None:
    from annotator.types import BoxKind, DetectorKind
    from annotator.workflows.detectors import own_model

    with open_project(cars) as project:
        read_ns, weights = project.store.clock(), project.models_folder / "view.pt"
        weights.touch()
        to_lorry(project)
        stored = project.models.register(
            DetectorKind.VIEW,
            weights,
            labels=("car",),
            box_kind=BoxKind.BOX,
            metrics={},
            fingerprint="f",
            created_ns=read_ns,
        )
        assert own_model(project, stored).names == (("car", "lorry"),)
