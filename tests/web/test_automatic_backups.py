"""A server backs up the projects that it has open, some hours after their first change."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import pytest
from replacing import replace_folder

from annotator.project import WriteContext, create_project
from annotator.project.backup.automatic import FOLDER, Reason, automatic_backups, back_up_automatically
from annotator.project.backup.take_in import restore
from annotator.types import BoxKind
from annotator.web.background import BACKUPS_PAUSE_S, AutomaticBackups
from annotator.web.context import Context
from annotator.web.folders import clear_leftovers
from annotator.web.security import ServerSettings

OLD = 1_000_000_000


@pytest.fixture
def changed(tmp_path: Path) -> Path:
    """A project whose first change was long ago."""
    with create_project(tmp_path, "room", ("person",), clock=lambda: OLD) as project:
        project.recordings.add(tmp_path / "take", "rgbd", "take", ["0"], True)
        project.boxes.set_on_image(1, [], BoxKind.BOX, WriteContext(0, "Ada"))
        return project.path


def test_an_open_project_is_backed_up_once_for_its_changes(changed: Path) -> None:
    context = Context(ServerSettings(changed.parent))
    try:
        backups = AutomaticBackups(context)
        backups.make_due()
        assert automatic_backups(changed) == []  # nobody has opened it
        context.project("room")
        for _ in range(2):
            backups.make_due()
        (made,) = automatic_backups(changed, Reason.CHANGES)
        path, manifest = restore(made, changed.parent, "restored")
        assert manifest.last_event == 1 and path.is_dir()
    finally:
        context.close()


def test_a_failed_backup_is_logged_and_tried_again_an_hour_later(
    changed: Path, caplog: pytest.LogCaptureFixture
) -> None:
    in_the_way, now = changed.parent / FOLDER, [0.0]
    in_the_way.write_text("in the way")
    context = Context(ServerSettings(changed.parent))
    try:
        context.project("room")
        backups = AutomaticBackups(context, lambda: now[0])
        with caplog.at_level(logging.WARNING, "annotator.web"):
            backups.make_due()
            in_the_way.unlink()
            now[0] = BACKUPS_PAUSE_S - 1
            backups.make_due()
        assert ["no automatic backup" in record.message for record in caplog.records] == [True]
        assert automatic_backups(changed) == []
        now[0] = BACKUPS_PAUSE_S
        backups.make_due()
        assert len(automatic_backups(changed)) == 1
    finally:
        context.close()


@pytest.mark.parametrize("has_failed", [False, True])
def test_neither_a_backup_nor_a_failure_of_a_replaced_project_counts_for_the_new_one(
    changed: Path, tmp_path: Path, has_failed: bool
) -> None:
    backup, made = shutil.copytree(changed, tmp_path / "copies" / "room"), changed.parent / FOLDER
    if has_failed:
        made.write_text("in the way")
    context = Context(ServerSettings(changed.parent))
    try:
        context.project("room")
        backups = AutomaticBackups(context, lambda: 0.0)
        backups.make_due()
        assert len(automatic_backups(changed)) == (not has_failed)
        if has_failed:
            made.unlink()
        else:
            shutil.rmtree(made)
        backups.make_due()
        assert automatic_backups(changed) == []
        replace_folder(changed, backup)
        context.project("room")
        backups.make_due()
        assert len(automatic_backups(changed)) == 1
    finally:
        context.close()


def test_what_a_killed_backup_has_left_is_removed_at_the_next_start(changed: Path) -> None:
    back_up_automatically(changed, Reason.CHANGES)
    left = changed.parent / FOLDER / "room" / f".room-backup.{'0' * 32}.unfinished"
    left.mkdir()
    clear_leftovers(changed.parent)
    assert not left.exists()
