"""Backups are made before an upgrade and some hours after a change, and only the last ones are kept."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import pytest
from backup_samples import content
from next_version import NOW, use_next, version_of
from store_samples import by_hand

from annotator.project import create_project, open_project
from annotator.project.backup.archive import read_manifest
from annotator.project.backup.make import BackupClock, Reason, automatic_backups, back_up_automatically
from annotator.project.backup.take_in import restore
from annotator.project.backup.verify import verify
from annotator.project.config import BACKUPS
from annotator.types import BoxKind
from annotator.types.errors import ProjectError


def test_a_database_is_backed_up_before_it_is_upgraded(full: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = content(full)
    use_next(monkeypatch)
    with open_project(full) as project:
        assert project.problems() == []
    (backup,) = automatic_backups(full)
    assert read_manifest(backup).database_version == NOW
    path, _ = restore(backup, full.parent, "older")
    assert content(path) == before
    assert verify(path, deep=True).problems == ()


def test_a_database_that_cannot_be_backed_up_is_not_upgraded(full: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_next(monkeypatch)
    (full.parent / BACKUPS).write_text("in the way")
    with pytest.raises(ProjectError, match="is not upgraded, because it cannot be backed up first"):
        open_project(full)
    assert version_of(full / "project.db") == NOW


def test_only_the_last_automatic_backups_of_a_reason_are_kept(full: Path) -> None:
    with open_project(full) as project:
        project.configure(settings=project.config.settings.model_copy(update={"backups_kept": 2}))
    made = [back_up_automatically(full, Reason.CHANGES).path for _ in range(4)]
    other = back_up_automatically(full, Reason.UPGRADE).path
    assert automatic_backups(full, Reason.CHANGES) == made[-2:]
    assert automatic_backups(full) == sorted([*made[-2:], other])


def test_a_backup_is_due_some_hours_after_the_first_change(tmp_path: Path) -> None:
    hours = [5.0]
    now = time.time_ns()
    with create_project(tmp_path, "hands", ("hand",), clock=lambda: now - int(hours[0] * 3600e9)) as project:
        project.recordings.add(tmp_path / "take", "rgbd", "take", ["0", "1"], True)
        clock = BackupClock(project.path, project.store)
        assert not clock.is_due()
        project.boxes.set_on_image(1, [], BoxKind.BOX, by_hand())
        assert clock.is_due()
        clock.made(back_up_automatically(project.path, Reason.CHANGES))
        assert not clock.is_due()
        hours[0] = 3.0
        project.boxes.set_on_image(2, [], BoxKind.BOX, by_hand())
        for each in (clock, BackupClock(project.path, project.store)):  # a new server reads the newest backup
            assert not each.is_due()
        project.configure(settings=project.config.settings.model_copy(update={"backup_hours": 2.0}))
        assert BackupClock(project.path, project.store).is_due()
        project.configure(settings=project.config.settings.model_copy(update={"backup_hours": None}))
        assert not clock.is_due()


def test_a_backup_of_more_events_than_the_project_has_says_nothing_about_it(tmp_path: Path) -> None:
    with create_project(tmp_path, "hands", ("hand",), clock=lambda: time.time_ns() - int(5 * 3600e9)) as project:
        project.recordings.add(tmp_path / "take", "rgbd", "take", ["0", "1"], True)
        older = shutil.copytree(project.path, tmp_path / "older")
        for frame in (1, 2):
            project.boxes.set_on_image(frame, [], BoxKind.BOX, by_hand())
        back_up_automatically(project.path, Reason.CHANGES)
    shutil.rmtree(project.path)
    older.rename(project.path)
    with open_project(project.path, clock=lambda: time.time_ns() - int(5 * 3600e9)) as restored:
        restored.boxes.set_on_image(1, [], BoxKind.BOX, by_hand())
        assert BackupClock(restored.path, restored.store).is_due()
