"""Backups restore to the state of one moment, and replace nothing."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest
from backup_samples import content, files
from store_samples import box_at, by_hand

from annotator.project import NewLabel, Project, open_project
from annotator.project.backup.archive import ModelChoice
from annotator.project.backup.make import back_up
from annotator.project.backup.take_in import copy_project, restore
from annotator.project.backup.verify import verify
from annotator.types.errors import AnnotatorError, ProjectError


def test_a_backup_restores_everything_but_what_can_be_made_again(full: Path, tmp_path: Path) -> None:
    back_up(full, tmp_path / "copy.zip")
    path, manifest = restore(tmp_path / "copy.zip", tmp_path / "elsewhere")
    assert path == tmp_path / "elsewhere" / "hands"
    assert content(path) == content(full)
    assert files(path) == {name for name in files(full) if "openvino" not in name}
    assert (manifest.labels, manifest.models) == (2, ModelChoice.ALL)
    assert verify(path, deep=True).problems == ()
    assert verify(full, deep=True).problems == ()


@pytest.mark.parametrize(("choice", "left"), [(ModelChoice.ACTIVE, ["two"]), (ModelChoice.NONE, [])])
def test_a_backup_can_leave_detectors_out(full: Path, tmp_path: Path, choice: ModelChoice, left: list[str]) -> None:
    back_up(full, tmp_path / "copy.zip", choice)
    path, _ = restore(tmp_path / "copy.zip", tmp_path, "other")
    with open_project(path) as opened:
        assert opened.config.name == "other"
        assert [model.fingerprint for model in opened.models.all()] == left
    assert {name.split("/")[2] for name in files(path) if name.startswith("models")} == set(left)
    assert verify(path, deep=True).problems == ()


def test_a_backup_is_the_state_of_one_moment_while_others_write(project: Project, frame: int, tmp_path: Path) -> None:
    stopped, errors = threading.Event(), list[Exception]()

    def write() -> None:
        try:
            while not stopped.is_set():
                revision = project.frames.get(frame).revision
                project.labels.create(frame, [NewLabel("hand", box_at(1.0 * revision))], by_hand(revision))
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=write)
    thread.start()
    try:
        for number in range(3):
            last = project.log.last()
            while project.log.last() < last + 3:
                assert thread.is_alive()
            back_up(project.path, tmp_path / f"{number}.zip")
    finally:
        stopped.set()
        thread.join()
    assert errors == []
    events = list(project.log.since())
    for number in range(3):
        path, manifest = restore(tmp_path / f"{number}.zip", tmp_path, f"copy{number}")
        with open_project(path) as restored:
            assert list(restored.log.since()) == events[: manifest.last_event]
            assert len(restored.labels.of_frame(frame)) == manifest.labels == manifest.last_event
        assert verify(path, deep=True).problems == ()


def test_existing_files_and_projects_are_never_replaced(full: Path, tmp_path: Path) -> None:
    back_up(full, tmp_path / "copy.zip")
    before = (tmp_path / "copy.zip").read_bytes()
    with pytest.raises(ProjectError, match="exists already; choose another file"):
        back_up(full, tmp_path / "copy.zip")
    with pytest.raises(ProjectError, match="exists already; choose another name"):
        restore(tmp_path / "copy.zip", tmp_path)
    with pytest.raises(ProjectError, match="exists already; choose another name"):
        copy_project(full, tmp_path, "hands")
    assert (tmp_path / "copy.zip").read_bytes() == before


def test_what_a_killed_command_has_left_is_removed_by_the_next(full: Path, tmp_path: Path) -> None:
    back_up(full, tmp_path / "copy.zip")
    left = [tmp_path / ".taken.0123.unfinished", tmp_path / ".other.0123.unfinished"]
    for folder in left:
        folder.mkdir()
        os.utime(folder, (1, 1))
    restore(tmp_path / "copy.zip", tmp_path, "taken")
    assert [folder.exists() for folder in left] == [False, True]


def test_errors_are_for_users(full: Path) -> None:
    with pytest.raises(AnnotatorError, match="no such file"):
        restore(full / "nothing.zip", full)
    with pytest.raises(AnnotatorError, match="is not a valid project name"):
        copy_project(full, full.parent, "Bad Name")
