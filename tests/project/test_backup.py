"""Backups restore to the state of one moment; damaged and hostile ones are refused, and leave nothing."""

from __future__ import annotations

import os
import shutil
import sqlite3
import stat
import struct
import threading
import time
import zipfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from store_samples import box_at, by_hand, by_machine, proposal_at, some_boxes, state_of
from time_limit import time_limit

from annotator.project import NewLabel, Project, StoredRecording, create_project, open_project
from annotator.project.backup import automatic
from annotator.project.backup.archive import read_manifest
from annotator.project.backup.automatic import BackupClock, Reason, automatic_backups, back_up_automatically
from annotator.project.backup.content import ModelChoice
from annotator.project.backup.make import back_up
from annotator.project.backup.repair import repair
from annotator.project.backup.take_in import copy_project, restore
from annotator.project.backup.verify import verify
from annotator.project.migrations import MIGRATIONS
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import AnnotatorError, FormatError, ProjectError


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A closed project with labels, boxes, a view, and two detectors of which one is active; do not change it."""
    root = tmp_path_factory.mktemp("template")
    with create_project(root, "hands", ("hand", "person")) as project:
        project.recordings.add(root / "take", "rgbd", "take", [str(n) for n in range(5)], True)
        frames = [frame.id for frame in project.frames.of()]
        project.proposals.replace(frames[0], [proposal_at(0.0), proposal_at(5.0)], by_machine())
        project.labels.accept(frames[0], project.labels.of_frame(frames[0])[0].uid, by_hand(1))
        project.boxes.set_on_image(frames[1], some_boxes(2), BoxKind.BOX, by_hand())
        view = project.views.store(np.zeros((4, 4, 3), np.uint8))
        project.boxes.set_on_view(view, some_boxes(1), BoxKind.BOX, by_hand(1), frame_id=frames[1])
        project.frames.finalise(frames[2], by_hand())
        for name in ("one", "two"):
            run = project.models_folder / "image" / name
            for part in ("validation", "detector-openvino-0123abcd"):
                (run / part).mkdir(parents=True)
                (run / part / "0.jpg").write_bytes(b"jpg")
            weights = run / "detector.safetensors"
            weights.write_bytes(name.encode())
            (run / "run.json").write_text("{}")
            project.models.register(
                DetectorKind.IMAGE, weights, labels=["hand"], box_kind=BoxKind.BOX, metrics={}, fingerprint=name
            )
    return root / "hands"


@pytest.fixture
def full(template: Path, tmp_path: Path) -> Path:
    """A copy of the template that a test may change."""
    return Path(shutil.copytree(template, tmp_path / "hands"))


def content(project: Path) -> dict[str, list[tuple[object, ...]]]:
    with open_project(project) as opened:
        return state_of(opened)


def files(folder: Path) -> set[str]:
    """The files below a folder, without SQLite's temporary ones."""
    found = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}
    return {name for name in found if not name.endswith(("-wal", "-shm"))}


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


Change = Callable[[Path, Path], None]
"""Writes a changed backup: (of this one, to this file)."""


def rezipped(change: Callable[[zipfile.ZipInfo, bytes], list[tuple[zipfile.ZipInfo, bytes]]]) -> Change:
    def write(old: Path, new: Path) -> None:
        with zipfile.ZipFile(old) as source, zipfile.ZipFile(new, "w") as target:
            for info in source.infolist():
                for each, data in change(info, source.read(info)):
                    target.writestr(each, data)

    return write


def also(name: str, mode: int = stat.S_IFREG | 0o600, data: bytes = b"x") -> Change:
    """Adds an entry that the manifest does not list."""

    def change(info: zipfile.ZipInfo, content: bytes) -> list[tuple[zipfile.ZipInfo, bytes]]:
        if info.filename != "manifest.json":
            return [(info, content)]
        added = zipfile.ZipInfo(name)
        added.external_attr = mode << 16
        return [(info, content), (added, data)]

    return rezipped(change)


def renamed(name: str) -> Change:
    """Gives the first view another name, in the manifest, too."""

    def change(info: zipfile.ZipInfo, content: bytes) -> list[tuple[zipfile.ZipInfo, bytes]]:
        if info.filename.startswith("views/"):
            info = zipfile.ZipInfo(name)
        if info.filename == "manifest.json":
            view = content[content.index(b"views/") :].split(b'"')[0]
            content = content.replace(view, name.encode())
        return [(info, content)]

    return rezipped(change)


def with_mode(mode: int) -> Change:
    def change(info: zipfile.ZipInfo, content: bytes) -> list[tuple[zipfile.ZipInfo, bytes]]:
        if info.filename.startswith("views/"):
            info.external_attr = mode << 16
        return [(info, content)]

    return rezipped(change)


def grown(info: zipfile.ZipInfo, content: bytes) -> list[tuple[zipfile.ZipInfo, bytes]]:
    return [(info, content + b"0" * 1000 if info.filename == "project.db" else content)]


def other_bytes(info: zipfile.ZipInfo, content: bytes) -> list[tuple[zipfile.ZipInfo, bytes]]:
    return [(info, content[:-1] + b"\0" if info.filename.startswith("views/") else content)]


def twice(info: zipfile.ZipInfo, content: bytes) -> list[tuple[zipfile.ZipInfo, bytes]]:
    return [(info, content)] * (2 if info.filename.startswith("views/") else 1)


def lacking(info: zipfile.ZipInfo, content: bytes) -> list[tuple[zipfile.ZipInfo, bytes]]:
    return [] if info.filename.startswith("views/") else [(info, content)]


def cut(old: Path, new: Path) -> None:
    new.write_bytes(old.read_bytes()[:-200])


BAD_BACKUPS: list[tuple[str, Change, str]] = [
    ("not a zip", lambda old, new: [new.write_bytes(b"nothing"), None][1], "cannot be read as a backup"),
    ("cut", cut, "cannot be read as a backup"),
    ("an unlisted file", also("views/x"), "which its manifest does not list"),
    ("an absolute path", renamed("/tmp/evil.png"), "which is no file of a project"),
    ("a path that leads out", renamed("views/../../evil.png"), "which is no file of a project"),
    ("a hidden file", renamed("models/image/.bashrc"), "which is no file of a project"),
    ("a link", with_mode(stat.S_IFLNK | 0o777), "a link, a device or a folder"),
    ("a device", with_mode(stat.S_IFCHR | 0o600), "a link, a device or a folder"),
    ("more bytes than declared", rezipped(grown), "has another size than its manifest says"),
    ("other bytes", rezipped(other_bytes), "its size or hash differs"),
    ("a file twice", rezipped(twice), "contains a file twice"),
    ("a missing file", rezipped(lacking), "which its manifest lists"),
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


def damage(statement: str) -> Callable[[Path], None]:
    def change(project: Path) -> None:
        with closing(sqlite3.connect(project / "project.db", isolation_level=None)) as connection:
            connection.execute("PRAGMA writable_schema = ON")
            for each in statement.split(";;"):
                connection.execute(each)

    return change


def overwritten(project: Path) -> None:
    """Zeroes a page in the middle of the database."""
    database = project / "project.db"
    with database.open("r+b") as file:
        file.seek(4096 * (database.stat().st_size // 4096 // 2))
        file.write(b"\0" * 4096)


NO_TRIGGER = "DROP TRIGGER events_are_not_deleted"
SHALLOW: list[tuple[str, Callable[[Path], None], str]] = [
    ("a dropped table", damage("DROP TABLE labels"), "lacks the table labels"),
    ("a dropped trigger", damage(NO_TRIGGER), "lacks the trigger events_are_not_deleted"),
    (
        "a foreign trigger",
        damage("CREATE TRIGGER evil AFTER INSERT ON events BEGIN DELETE FROM labels; END"),
        "has the trigger 'evil', which does not belong to a project",
    ),
    ("a foreign view", damage("CREATE VIEW evil AS SELECT 1"), "has the view 'evil'"),
    ("a foreign table", damage("CREATE TABLE sqlite_evil_ (a)".replace("sqlite_", "")), "has the table 'evil_'"),
    ("a changed table", damage("ALTER TABLE frames ADD COLUMN more TEXT"), "the table frames is not that of a project"),
    ("version 0", damage("PRAGMA user_version = 0"), "has database version 0"),
    ("a negative version", damage("PRAGMA user_version = -5"), "has database version -5"),
    ("a missing row", damage("DELETE FROM runs;;DELETE FROM recordings"), "refers to a missing row of recordings"),
    ("an overwritten page", overwritten, "project.db: "),
]
DEEP: list[tuple[str, Callable[[Path], None], str]] = [
    ("a changed label", damage("UPDATE labels SET state = 'rejected'"), "labels has other values than the events give"),
    ("a removed label", damage("DELETE FROM labels"), "labels lacks rows that the events give"),
    (
        "an added label",
        damage(
            "INSERT INTO labels (uid, frame_id, label, box, source, state, author, time_ns, event_id, track_linked) "
            "VALUES ('x', 1, 'hand', '{}', 'manual', 'accepted', 'a', 1, 1, 0)"
        ),
        "labels has rows that the events do not give: x",
    ),
    ("a missing view", lambda path: [view.unlink() for view in path.glob("views/*")] and None, "are missing"),
    ("a damaged view", lambda path: [view.write_bytes(b"") for view in path.glob("views/*")] and None, "are damaged"),
    (
        "a view that is a link",
        lambda path: [(view.rename(path / "x"), view.symlink_to(path / "x")) for view in path.glob("views/*")] and None,
        "no regular files",
    ),
    (
        "a missing detector",
        lambda path: (path / "models/image/one/detector.safetensors").unlink(),
        "files of detectors are missing",
    ),
    (
        "a detector elsewhere",
        damage("UPDATE models SET path = '../../x.pt' WHERE active"),
        "files of detectors are outside the project: ../../x.pt",
    ),
]


@pytest.mark.parametrize(("change", "says"), [pytest.param(*row[1:], id=row[0]) for row in SHALLOW])
def test_verify_finds_a_damaged_database(full: Path, change: Callable[[Path], None], says: str) -> None:
    change(full)
    for deep in (False, True):
        assert says in " ".join(verify(full, deep=deep).problems)
    with pytest.raises(ProjectError):
        back_up(full, full.parent / "copy.zip")
    with pytest.raises(ProjectError):
        copy_project(full, full.parent, "taken")
    assert {path.name for path in full.parent.iterdir()} == {"hands"}


@pytest.mark.parametrize(("change", "says"), [pytest.param(*row[1:], id=row[0]) for row in DEEP])
def test_a_deep_verification_finds_what_differs_from_the_events(
    full: Path, change: Callable[[Path], None], says: str
) -> None:
    change(full)
    assert verify(full).problems == ()
    assert says in " ".join(verify(full, deep=True).problems)
    with pytest.raises(ProjectError, match="nothing was copied"):
        copy_project(full, full.parent, "taken")
    assert {path.name for path in full.parent.iterdir()} == {"hands"}


def test_a_foreign_project_is_copied_without_links_and_caches(full: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("secret")
    before = content(full)
    (full / "models/image/one/validation/1.jpg").symlink_to(secret)
    (full / "models/image/two/validation").rename(tmp_path / "away")
    (full / "models/image/two/validation").symlink_to(tmp_path / "away")
    os.mkfifo(full / "models/image/one/pipe")
    (full / "cache").mkdir()
    (full / "cache/points.json").write_text("{}")
    path = copy_project(full, tmp_path / "mine", "taken")
    assert content(path) == before
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


# --- restoring by hand ------------------------------------------------------------------------------------------------


def write_and_be_killed(project: Path) -> None:
    """Adds three labels, and leaves the files as they are while the database is open: as after a kill."""
    left = project.parent / "left"
    with open_project(project) as opened:
        for _ in range(3):
            frame = opened.frames.of()[4]
            opened.labels.create(frame.id, [NewLabel("hand", box_at(9.0))], by_hand(frame.revision))
        shutil.copytree(project, left)
    for name in ("project.db", "project.db-wal"):
        (left / name).replace(project / name)
    shutil.rmtree(left)


def test_a_database_copied_beside_a_left_wal_is_not_mixed_with_it(full: Path, tmp_path: Path) -> None:
    shutil.copyfile(full / "project.db", tmp_path / "by_hand.db")
    before = content(full)
    write_and_be_killed(full)
    shutil.copyfile(tmp_path / "by_hand.db", full / "project.db")
    with pytest.raises(ProjectError, match=r"does not belong to the file project\.db-wal beside it"):
        open_project(full)
    assert "does not belong" in verify(full).problems[0]
    repaired = repair(full)
    assert (repaired.path, repaired.is_new, repaired.lost) == (tmp_path / "hands-repaired", True, {})
    assert content(repaired.path) == before
    assert verify(repaired.path, deep=True).problems == ()
    assert (full / "project.db-wal").exists()


def test_a_left_wal_of_the_database_itself_is_used(full: Path, tmp_path: Path) -> None:
    for _ in range(2):
        write_and_be_killed(full)
    moved = full.rename(tmp_path / "moved")
    with open_project(moved) as project:
        assert len(project.labels.of_frame(project.frames.of()[4].id)) == 6
    assert verify(moved, deep=True).problems == ()


def test_a_database_copied_in_the_middle_of_a_session_is_not_mixed_with_a_later_wal(full: Path, tmp_path: Path) -> None:
    write_and_be_killed(full)
    with open_project(full) as project:
        frame = project.frames.of()[3]
        project.labels.create(frame.id, [NewLabel("hand", box_at())], by_hand(frame.revision))
        shutil.copyfile(full / "project.db", tmp_path / "by_hand.db")
        with closing(sqlite3.connect(full / "project.db")) as connection:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    write_and_be_killed(full)
    shutil.copyfile(tmp_path / "by_hand.db", full / "project.db")
    with pytest.raises(ProjectError, match="does not belong"):
        open_project(full)


# --- repair -----------------------------------------------------------------------------------------------------------


def test_repair_makes_the_state_anew_after_a_backup(full: Path) -> None:
    before = content(full)
    damage("UPDATE labels SET state = 'rejected'")(full)
    repaired = repair(full)
    assert (repaired.path, repaired.is_new) == (full, False)
    assert content(full) == before
    assert verify(full, deep=True).problems == ()
    assert automatic_backups(full, Reason.REPAIR) == [repaired.backup]


def test_repair_saves_what_is_readable_of_a_damaged_database(project: Project, recording: StoredRecording) -> None:
    for frame in project.frames.of():
        for revision in range(20):
            project.labels.create(frame.id, [NewLabel("hand", box_at(1.0 * revision))], by_hand(revision))
    project.close()
    database = project.path / "project.db"
    with closing(sqlite3.connect(database)) as connection:
        tables = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'events'").fetchall()
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
    before, whole = database.read_bytes(), content(project.path)
    leaves = [page for page in range(1, pages) if b"label_created" in before[page * 4096 : page * 4096 + 4096]]
    assert tables and len(leaves) > 3
    with database.open("r+b") as file:  # one page of events, not the labels
        file.seek(leaves[len(leaves) // 2] * 4096)
        file.write(b"\0" * 4096)
    damaged = database.read_bytes()
    repaired = repair(project.path, "saved")
    assert repaired.is_new and repaired.lost and repaired.restored
    assert database.read_bytes() == damaged
    assert verify(repaired.path, deep=True).problems == ()
    saved = content(repaired.path)
    boxes = [sorted(str(row[3]) for row in state["labels"]) for state in (saved, whole)]
    assert boxes[0] == boxes[1]


def test_repair_of_something_that_is_no_database_says_so(full: Path) -> None:
    (full / "project.db").write_bytes(b"nothing" * 1000)
    with pytest.raises(ProjectError, match="nothing can be read"):
        repair(full)
    assert {path.name for path in full.parent.iterdir()} == {"hands"}


# --- automatic backups ------------------------------------------------------------------------------------------------


def test_a_database_is_backed_up_before_it_is_upgraded(full: Path) -> None:
    before = content(full)
    damage("DROP TABLE generation;;PRAGMA user_version = 14")(full)
    with open_project(full) as project:
        assert project.problems() == []
    (backup,) = automatic_backups(full)
    assert read_manifest(backup).database_version == MIGRATIONS[-1].version - 1
    path, _ = restore(backup, full.parent, "older")
    assert content(path) == before
    assert verify(path, deep=True).problems == ()


def test_a_database_that_cannot_be_backed_up_is_not_upgraded(full: Path) -> None:
    damage("DROP TABLE generation;;PRAGMA user_version = 14")(full)
    (full.parent / automatic.FOLDER).write_text("in the way")
    with pytest.raises(ProjectError, match="is not upgraded, because it cannot be backed up first"):
        open_project(full)
    with closing(sqlite3.connect(full / "project.db")) as connection:
        assert connection.execute("PRAGMA user_version").fetchone() == (14,)


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
        clock = BackupClock()
        assert not clock.is_due(project.path, project.store)
        project.boxes.set_on_image(1, [], BoxKind.BOX, by_hand())
        assert clock.is_due(project.path, project.store)
        clock.made(project.path, back_up_automatically(project.path, Reason.CHANGES))
        assert not clock.is_due(project.path, project.store)
        hours[0] = 3.0
        project.boxes.set_on_image(2, [], BoxKind.BOX, by_hand())
        for each in (clock, BackupClock()):  # a new server reads the newest backup
            assert not each.is_due(project.path, project.store)
        project.configure(settings=project.config.settings.model_copy(update={"backup_hours": 2.0}))
        assert BackupClock().is_due(project.path, project.store)
        project.configure(settings=project.config.settings.model_copy(update={"backup_hours": None}))
        assert not clock.is_due(project.path, project.store)


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
        assert BackupClock().is_due(restored.path, restored.store)


@pytest.mark.parametrize(
    "header",
    [struct.pack(">IIII", 0x377F0682, 3007000, 2**32 - 1, 0), struct.pack(">IIII", 0x377F0682, 3007000, 4096, 0)],
)
def test_a_huge_empty_wal_does_not_hold_up_an_open(full: Path, header: bytes) -> None:
    with (full / "project.db-wal").open("wb") as file:
        file.write(header)
        file.truncate(2**33)
    with time_limit(20), open_project(full) as project:
        assert project.problems() == []


# --- kills ------------------------------------------------------------------------------------------------------------


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
