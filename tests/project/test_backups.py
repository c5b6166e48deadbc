"""Backups are made before an upgrade and some hours after a change, and only the last ones are kept."""

from __future__ import annotations

import os
import shutil
import sqlite3
import stat
import threading
import time
import zipfile
from collections import namedtuple
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from store_samples import NOW, box_at, by_hand, files, stored_state, use_next, version_of

from annotator.project import NewLabel, Project, create_project, open_project
from annotator.project.backup import make, snapshot
from annotator.project.backup.archive import ModelChoice
from annotator.project.backup.make import Reason, automatic_backups, back_up, back_up_automatically, is_backup_due
from annotator.project.backup.repair import repair
from annotator.project.backup.take_in import copy_project, restore
from annotator.project.backup.verify import verify
from annotator.project.config import BACKUPS
from annotator.types import BoxKind
from annotator.types.errors import FormatError, ProjectError


def test_a_database_is_backed_up_before_it_is_upgraded(full: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = stored_state(full)
    use_next(monkeypatch)
    with open_project(full) as project:
        assert project.problems() == []
    (backup,) = automatic_backups(full)
    path, _ = restore(backup, full.parent, "older")
    assert stored_state(path) == before
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
        assert not is_backup_due(project.path, project.store)
        project.boxes.set_on_image(1, [], BoxKind.BOX, by_hand())
        assert is_backup_due(project.path, project.store)
        back_up_automatically(project.path, Reason.CHANGES)
        assert not is_backup_due(project.path, project.store)
        hours[0] = 3.0
        project.boxes.set_on_image(2, [], BoxKind.BOX, by_hand())
        assert not is_backup_due(project.path, project.store)
        project.configure(settings=project.config.settings.model_copy(update={"backup_hours": 2.0}))
        assert is_backup_due(project.path, project.store)
        project.configure(settings=project.config.settings.model_copy(update={"backup_hours": None}))
        assert not is_backup_due(project.path, project.store)


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
        assert is_backup_due(restored.path, restored.store)


def test_a_backup_restores_everything_but_what_can_be_made_again(full: Path, tmp_path: Path) -> None:
    back_up(full, tmp_path / "copy.zip")
    path, manifest = restore(tmp_path / "copy.zip", tmp_path / "elsewhere")
    assert path == tmp_path / "elsewhere" / "hands"
    assert stored_state(path) == stored_state(full)
    assert files(path) == {name for name in files(full) if "openvino" not in name}
    assert manifest.labels == 2
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
            assert len(restored.labels.of_frame(frame)) == manifest.labels == manifest.last_event - 1
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


def test_a_foreign_project_is_copied_without_links_and_caches(full: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("secret")
    before = stored_state(full)
    (full / "models/image/one/validation/1.jpg").symlink_to(secret)
    (full / "models/image/two/validation").rename(tmp_path / "away")
    (full / "models/image/two/validation").symlink_to(tmp_path / "away")
    os.mkfifo(full / "models/image/one/pipe")
    (full / "cache").mkdir()
    (full / "cache/points.json").write_text("{}")
    path = copy_project(full, tmp_path / "mine", "taken")
    assert stored_state(path) == before
    left_out = {"cache/points.json", "models/image/one/pipe", "models/image/one/validation/1.jpg"}
    assert files(path) == {
        name for name in files(full) - left_out if "openvino" not in name and "two/valid" not in name
    }
    assert not [path for path in path.rglob("*") if path.is_symlink()]


@pytest.mark.parametrize("name", ["project.json", "project.db"])
def test_a_foreign_project_whose_main_files_are_links_is_refused(full: Path, tmp_path: Path, name: str) -> None:
    (full / name).rename(tmp_path / name)
    (full / name).symlink_to(tmp_path / name)
    with pytest.raises(ProjectError, match=f"{name} is missing or no regular file"):
        copy_project(full, tmp_path, "taken")


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """An empty project."""
    create_project(tmp_path, "room", ("hand",)).close()
    return tmp_path / "room"


def test_a_backup_does_not_fill_the_disk(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "free")
    monkeypatch.setattr(make.shutil, "disk_usage", lambda path: usage(make.SPARE_BYTES))
    with pytest.raises(ProjectError, match=r"may take 33 MiB, .* the disk has 32 MiB; free some space"):
        back_up(room, room.parent / "copy.zip")
    assert [path.name for path in room.parent.iterdir()] == ["room"]


def test_a_project_behind_a_link_has_one_place_for_its_backups(room: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    linked = tmp_path / "elsewhere" / "linked"
    linked.symlink_to(room)
    back_up_automatically(linked, Reason.CHANGES)
    back_up_automatically(room, Reason.CHANGES)
    assert len(automatic_backups(linked)) == len(automatic_backups(room)) == 2


def test_a_locked_project_is_not_taken_for_a_damaged_one(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(snapshot, "BUSY_TIMEOUT_S", 0.01)
    with closing(sqlite3.connect(room / "project.db")) as other:
        other.execute("PRAGMA journal_mode = DELETE")
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(ProjectError, match="is locked by another process"):
            repair(room)
    assert [path.name for path in room.parent.iterdir()] == ["room"]


Change = Callable[[Path, Path], object]
"""Writes a changed backup: (of this one, to this file)."""
Entry = tuple[zipfile.ZipInfo, bytes]


def rezipped(start: str, change: Callable[[zipfile.ZipInfo, bytes], list[Entry]]) -> Change:
    """Changes the entries whose names start so."""

    def write(old: Path, new: Path) -> None:
        with zipfile.ZipFile(old) as source, zipfile.ZipFile(new, "w") as target:
            for info in source.infolist():
                entry = (info, source.read(info))
                for each, data in change(*entry) if info.filename.startswith(start) else [entry]:
                    target.writestr(each, data)

    return write


def renamed(name: str) -> Change:
    """Gives the view another name."""
    return rezipped("views/", lambda _, data: [(zipfile.ZipInfo(name), data)])


def altered(old: Path, new: Path) -> None:
    """Changes a byte of the view."""
    content = bytearray(old.read_bytes())
    content[content.index(b"IHDR") + 4] ^= 1
    new.write_bytes(content)


def with_mode(mode: int) -> Change:
    def change(info: zipfile.ZipInfo, stored_state: bytes) -> list[Entry]:
        info.external_attr = mode << 16
        return [(info, stored_state)]

    return rezipped("views/", change)


BAD_BACKUPS: list[tuple[str, Change, str]] = [
    ("no file", lambda old, new: None, "no such file; give a file that"),
    ("a folder", lambda old, new: new.mkdir(), "is a folder; `annotator project copy` takes in"),
    ("not a zip", lambda old, new: new.write_bytes(b"nothing"), "cannot be read as a backup"),
    ("cut", lambda old, new: new.write_bytes(old.read_bytes()[:-200]), "cannot be read as a backup"),
    ("an absolute path", renamed("/tmp/evil.png"), "which is no file of a project"),
    ("a path that leads out", renamed("views/../../evil.png"), "which is no file of a project"),
    ("a hidden file", renamed("models/image/.bashrc"), "which is no file of a project"),
    ("a link", with_mode(stat.S_IFLNK | 0o777), "a link or a device"),
    ("a device", with_mode(stat.S_IFCHR | 0o600), "a link or a device"),
    ("other bytes", altered, "Bad CRC-32 for file 'views/"),
    ("a file twice", rezipped("views/", lambda info, data: [(info, data)] * 2), "contains a file twice"),
    ("a missing file", rezipped("views/", lambda *_: []), "contains 8 files, but should have 9"),
]


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(("change", "says"), [pytest.param(*row[1:], id=row[0]) for row in BAD_BACKUPS])
def test_a_bad_backup_is_refused_and_leaves_nothing(full: Path, tmp_path: Path, change: Change, says: str) -> None:
    back_up(full, tmp_path / "good.zip")
    change(tmp_path / "good.zip", tmp_path / "bad.zip")
    root = tmp_path / "projects"
    root.mkdir()
    with pytest.raises(FormatError, match=says):
        restore(tmp_path / "bad.zip", root)
    assert list(root.iterdir()) == []
