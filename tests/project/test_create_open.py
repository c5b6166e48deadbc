"""Creating, opening and listing projects; errors name the problem and its solution."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sqlite3
import threading
from collections.abc import Callable
from contextlib import closing
from functools import partial, partialmethod
from pathlib import Path

import pytest
from store_samples import NOW, box_at, by_hand, damage, state_of, use_next, version_of
from time_limit import time_limit

from annotator.files import read_file
from annotator.project import (
    BoxRotation,
    NewLabel,
    Project,
    ProjectSettings,
    create_project,
    list_projects,
    open_project,
)
from annotator.project.backup.verify import verify
from annotator.project.classes import edit
from annotator.project.config import read_config, rename_project
from annotator.project.database.store import open_store, waiting_at_most
from annotator.types import Box2D, BoxKind
from annotator.types.errors import ConfigError, ProjectError


def test_a_new_project_has_its_files(tmp_path: Path) -> None:
    settings = ProjectSettings(rotation=BoxRotation.UPRIGHT)
    create_project(tmp_path / "projects", "hands", ["hand"], settings=settings, clock=lambda: 123).close()
    folder = tmp_path / "projects" / "hands"
    assert {path.name for path in folder.iterdir()} == {"project.json", "project.db", "models", "views"}
    assert json.loads((folder / "project.json").read_text()) == {
        "name": "hands",
        "format_version": 2,
        "created_ns": 123,
        "settings": {
            "rotation": "upright",
            "rcv": {},
            "learn_every": None,
            "learn_minutes": 3.0,
            "box_kind": "silhouette",
            "backup_hours": 4.0,
            "backups_kept": 5,
        },
    }
    with open_project(folder) as project:
        assert project.config.classes == ("hand",)
        assert project.problems() == []


def test_the_database_has_safe_pragmas(project: Project) -> None:
    with project.store.read() as connection:
        wanted = {"journal_mode": "wal", "foreign_keys": 1, "synchronous": 2, "busy_timeout": 10_000}
        for pragma, value in wanted.items():
            assert connection.exec_driver_sql(f"PRAGMA {pragma}").scalar_one() == value


@pytest.mark.parametrize("name", ["", "Hands", "../up", "-x", "é", "x" * 65, "a\n"])
def test_a_bad_name_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="not a valid project name"):
        create_project(tmp_path, name, ["hand"])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("classes", [[], ["hand", "hand"], [""], [" hand"], ["a/b"], ["a\nb"], ["x" * 65]])
def test_bad_classes_are_refused(tmp_path: Path, classes: list[str]) -> None:
    with pytest.raises(ConfigError, match="project hands: classes"):
        create_project(tmp_path, "hands", classes)
    assert list(tmp_path.iterdir()) == []


def test_only_one_of_several_threads_creates_a_project(tmp_path: Path) -> None:
    barrier = threading.Barrier(4)
    outcomes: list[str] = []

    def create() -> None:
        barrier.wait()
        try:
            create_project(tmp_path, "hands", ["hand"]).close()
            outcomes.append("created")
        except ProjectError as error:
            assert "exists already" in str(error)
            outcomes.append("refused")

    threads = [threading.Thread(target=create) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(outcomes) == ["created", "refused", "refused", "refused"]
    assert [path.name for path in tmp_path.iterdir()] == ["hands"]


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ProjectError, match="cannot be created"):
        create_project(tmp_path / "file", "hands", ["hand"])


def _overwrite(name: str, content: bytes) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes(content) and None


def _truncate(folder: Path) -> None:
    content = (folder / "project.db").read_bytes()
    (folder / "project.db").write_bytes(content[: len(content) // 2])


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (lambda folder: (folder / "project.json").unlink(), "is not a project: it has no project.json"),
        (_overwrite("project.json", b"{"), "project.json: .*restore it"),
        (_overwrite("project.json", b"[" * 200_000), "project.json: .*restore it"),
        (_overwrite("project.json", b'{"format_version": 3}'), "format version 3.*update annotator"),
        (_overwrite("project.json", b'{"format_version": 1}'), "use the version that made it"),
        (_overwrite("project.json", b'{"format_version": 2, "name": "x"}'), "Field required"),
        (damage("UPDATE classes SET position = NULL"), "needs at least one class; restore it"),
        (lambda folder: (folder / "project.db").unlink(), "project.db: is missing"),
        (_overwrite("project.db", b"x" * 5000), "project.db: is not a project database"),
        (_overwrite("project.db", b""), "not a project database"),
        (_truncate, "project.db: is damaged"),
        (
            damage("DROP TABLE view_labels"),
            "lacks the table view_labels, so it was not opened.*restore it",
        ),
        (damage("ALTER TABLE models DROP COLUMN metrics"), "the table models is not that of a project"),
        (damage("PRAGMA user_version = -5"), "is damaged: its version is -5"),
        (
            damage("PRAGMA user_version = 99"),
            r"newer annotator \(database version 99, this one supports up to \d+\); update annotator",
        ),
    ],
)
def test_opening_a_damaged_project_raises_a_clear_error(
    tmp_path: Path, harm: Callable[[Path], None], message: str
) -> None:
    create_project(tmp_path, "hands", ["hand"]).close()
    harm(tmp_path / "hands")
    with pytest.raises(ProjectError, match=message), open_project(tmp_path / "hands") as project:
        project.config  # noqa: B018


@pytest.mark.parametrize("name", ["project.json", "project.db", "project.db-journal"])
@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")], ids=["pipe", "device"])
def test_a_pipe_or_device_in_place_of_a_file_is_an_error(project: Project, name: str, make: Callable[[Path], object]):
    project.close()
    (project.path / name).unlink(missing_ok=True)
    make(project.path / name)
    with time_limit(20), pytest.raises(ProjectError, match=rf"{name}: (is missing|.*not a regular|is a link that)"):
        open_project(project.path)


def test_a_lock_that_outlasts_the_timeout_is_reported(project: Project, frame: int) -> None:
    other = sqlite3.connect(project.path / "project.db", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    try:
        with (
            open_project(project.path) as waiting,
            waiting_at_most(0.1),
            pytest.raises(ProjectError, match="locked by another process"),
        ):
            waiting.frames.finalise(frame, by_hand())
        assert project.frames.get(frame).revision == 0, "the lock does not block readers"
    finally:
        other.rollback()
        other.close()
    project.frames.finalise(frame, by_hand())


def test_the_path_may_contain_special_characters(tmp_path: Path) -> None:
    root = tmp_path / "a b?c#d%41&mode=memory"
    create_project(root, "hands", ["hand"]).close()
    with open_project(root / "hands") as project:
        assert project.recordings.all() == ()
    assert (root / "hands" / "project.db").stat().st_size > 0


def test_a_missing_sub_folder_is_created_again(project: Project) -> None:
    (project.path / "views").rmdir()
    with open_project(project.path) as reopened:
        assert reopened.views.folder.is_dir()


def test_projects_are_listed_with_their_problems(tmp_path: Path) -> None:
    for name in ("b", "a", "c"):
        create_project(tmp_path, name, [name]).close()
    (tmp_path / "c" / "project.json").write_text("{}")
    (tmp_path / "other").mkdir()
    (tmp_path / ".a.0123.unfinished").mkdir()
    listed = list_projects(tmp_path)
    assert [entry.path.name for entry in listed] == ["a", "b", "c"]
    assert [entry.problem is None for entry in listed] == [True, True, False]
    assert "project.json" in (listed[2].problem or "")
    assert list_projects(tmp_path / "none") == ()


def test_an_unreadable_project_is_listed_with_its_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        create_project(tmp_path, name, ["a"]).close()

    def refused(path: Path, ask: Callable[..., object], **options: object) -> object:
        if path.parent.name == "b":
            raise PermissionError(errno.EACCES, "Permission denied")
        return ask(path, **options)

    monkeypatch.setattr(Path, "stat", partialmethod(refused, Path.stat))
    monkeypatch.setattr("annotator.project.config.read_file", partial(refused, ask=read_file))
    fine, locked = list_projects(tmp_path)
    assert fine.problem is None
    assert "cannot be read: [Errno 13] Permission denied" in (locked.problem or "")


def test_classes_can_be_added_but_not_removed_from_boxes(project: Project, frame: int) -> None:
    with open_project(project.path) as other:
        other.configure(classes=["hand", "person", "dog"])
    with pytest.raises(ProjectError, match="a track id must lie in"):
        NewLabel("dog", box_at(), track_id=10**30)
    receipt = project.labels.create(frame, [NewLabel("dog", box_at(), track_id=2**53)], by_hand()).receipt
    boxes = [Box2D("person", 0.0, 0.0, 1.0, 1.0)]
    project.boxes.set_on_image(frame, boxes, BoxKind.SILHOUETTE, by_hand(receipt.revision))
    for remaining, removed in ((["hand", "person"], "'dog'"), (["dog", "hand"], "'person'")):
        with pytest.raises(ProjectError, match=f"{removed} cannot be removed"):
            project.configure(classes=remaining)
    assert project.configure(classes=["dog", "person"]).classes == ("dog", "person")
    with pytest.raises(ConfigError):
        project.configure(classes=[])
    assert project.config.classes == ("dog", "person")


@pytest.fixture
def cars(tmp_path: Path) -> Path:
    with create_project(tmp_path, "cars", ("car",)):
        return tmp_path / "cars"


def to_lorry(project: Project) -> None:
    project.change_classes(edit.RenameClass(name="car", new="lorry"), "ann")


def test_a_rename_keeps_what_was_changed_just_before(cars: Path, monkeypatch) -> None:
    class Late:
        def __init__(self, folder: Path) -> None:
            with open_project(folder) as project:
                project.configure(settings=ProjectSettings(learn_every=7))

        def __enter__(self) -> None: ...

        def __exit__(self, *_: object) -> None: ...

    monkeypatch.setattr("annotator.project.config.not_in_use", Late)
    rename_project(cars, "lorries")
    config = read_config(cars.parent / "lorries")
    assert (config.name, config.settings.learn_every) == ("lorries", 7)


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


def test_an_upgraded_database_keeps_its_content_and_has_the_tables_of_a_new_one(
    full: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_project(full) as project:
        before = state_of(project)
    use_next(monkeypatch)
    with open_project(full) as project:
        assert state_of(project) == before
        project.log.rebuild()
        assert state_of(project) == before
        assert project.problems() == []
    assert version_of(full / "project.db") == NOW + 1
    assert verify(full, deep=True).problems == ()
    create_project(full.parent, "new", ["hand"]).close()
    schemas = []
    for folder in (full, full.parent / "new"):
        with closing(sqlite3.connect(folder / "project.db")) as connection:
            schemas.append(connection.execute("SELECT type, name, sql FROM sqlite_master ORDER BY name").fetchall())
    assert schemas[0] == schemas[1]


def test_an_upgrade_that_is_killed_afterwards_leaves_a_database_that_opens(
    full: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_next(monkeypatch)
    left = tmp_path / "left"
    store = open_store(full / "project.db")
    shutil.copytree(full, left)  # as after a kill: with the `-wal`
    store.close()
    assert (left / "project.db-wal").stat().st_size > 0
    open_store(left / "project.db").close()


def test_a_migration_that_fails_leaves_the_database_as_it_was(full: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        use_next(patch, ("CREATE TABLE half (a)", "CREATE TABLE frames (a)"))
        with pytest.raises(ProjectError, match=r"its tables are not those of its version; .* already exists"):
            open_store(full / "project.db")
    assert version_of(full / "project.db") == NOW
    with open_project(full) as project, project.store.read() as connection:
        names = connection.exec_driver_sql("SELECT name FROM sqlite_master").scalars().all()
        assert "half" not in names
        project.frames.finalise(2, by_hand(project.frames.get(2).revision))
