"""Projects that are replaced while open, or that somebody sent: nothing outside their folder is touched."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from store_samples import box_at, by_hand, replace_database, replace_folder, stored_state

from annotator.project import NewLabel, Project, StoredRecording, create_project, list_projects, open_project
from annotator.project.backup.repair import repair
from annotator.project.backup.verify import verify
from annotator.types.errors import NotFoundError, ProjectError, ReplacedError


@pytest.fixture
def backup(project: Project, frame: int, tmp_path: Path) -> Iterator[Path]:
    """A copy of the project with one label; the project gets a second one later."""
    _label(project, frame)
    copy = tmp_path / "backup"
    shutil.copytree(project.path, copy)
    _label(project, frame)
    yield copy


def _label(project: Project, frame: int) -> None:
    project.labels.create(frame, [NewLabel("hand", box_at())], by_hand(project.frames.get(frame).revision))


def _link(folder: Path, backup: Path) -> None:
    folder.rename(folder.with_name("moved"))
    folder.symlink_to(backup)


@pytest.mark.parametrize("replace", [replace_folder, replace_database, _link])
def test_a_replaced_project_refuses_writes_and_is_sound_when_opened_anew(
    project: Project, frame: int, backup: Path, replace: Callable[[Path, Path], None]
) -> None:
    assert project.history.undo("ann").words == "draw hand (frame 3)"
    assert project.history.next("ann") == ("draw hand (frame 3)",) * 2
    replace(project.path, backup)
    assert not project.is_current
    with pytest.raises(ReplacedError, match="was replaced by another file while it was open"):
        _label(project, frame)
    with pytest.raises(ReplacedError):
        project.history.next("ann")
    with pytest.raises(ReplacedError):
        project.labels.of_frame(frame)
    project.close()
    with open_project(project.path) as anew:
        assert anew.problems() == []
        assert len(anew.labels.of_frame(frame)) == 1, "the backup's state, not mixed with what came after it"
        assert anew.history.next("ann") == ("draw hand (frame 3)", None)
        _label(anew, frame)
    with open_project(project.path) as again:
        assert len(again.labels.of_frame(frame)) == 2


@pytest.mark.parametrize("suffix", ["", "-wal", "-shm"])
def test_a_removed_file_is_noticed(project: Project, frame: int, backup: Path, suffix: str) -> None:
    (project.path / f"project.db{suffix}").unlink()
    with pytest.raises(ReplacedError, match=f"project.db{suffix}: was removed while it was open"):
        _label(project, frame)
    project.close()
    if not suffix:
        with pytest.raises(ProjectError, match=r"project\.db: is missing; restore it"):
            open_project(project.path)
        return
    with open_project(project.path) as anew:
        assert anew.problems() == []
        assert len(anew.labels.of_frame(frame)) == 2


def test_a_replacement_during_a_write_is_noticed_before_it_is_acknowledged(
    project: Project, frame: int, backup: Path
) -> None:
    with pytest.raises(ReplacedError), project.store.write():
        replace_folder(project.path, backup)
    # or between a connection's opening and its use
    with open_project(project.path) as anew:
        held = [anew.store.engine.connect() for _ in range(anew.store.engine.pool.checkedin())]
        replace_folder(project.path, backup)
        with pytest.raises(ReplacedError):
            anew.log.last()
        for connection in held:
            connection.close()


def test_a_project_that_cannot_be_written_can_be_read(
    project: Project, recording: StoredRecording, frame: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    _label(project, frame)
    project.close()
    before = {path.name: path.stat().st_mtime_ns for path in project.path.iterdir()}
    monkeypatch.setattr("annotator.project.database.store.os.access", lambda *_: False)
    with open_project(project.path) as reading:
        assert len(reading.labels.of_frame(frame)) == 1
        assert reading.statistics().frames == 5
        with pytest.raises(ProjectError, match=r"read-only disk, .* so nothing was saved; .* copy its folder"):
            _label(reading, frame)
        assert {path.name: path.stat().st_mtime_ns for path in project.path.iterdir()} == before
    monkeypatch.undo()
    with open_project(project.path) as writing, monkeypatch.context() as patch:
        # another user, with more rights, has it open: the latest changes are beside the database
        _label(writing, frame)
        patch.setattr("annotator.project.database.store.os.access", lambda *_: False)
        with open_project(project.path) as reading:
            assert len(reading.labels.of_frame(frame)) == 2
    with monkeypatch.context() as patch:
        patch.setattr("annotator.project.database.store.os.access", lambda *_: False)
        reading = open_project(project.path)
    with reading, open_project(project.path) as writing:
        # it was read without locks, and is written now
        _label(writing, frame)
        with pytest.raises(ReplacedError):
            reading.labels.of_frame(frame)


def write_and_be_killed(project: Path) -> None:
    """Adds 12 labels, which fill more than a page, and leaves the files as while the database is open: after a kill."""
    left = project.parent / "left"
    with open_project(project) as opened:
        for _ in range(12):
            frame = opened.frames.of()[4]
            opened.labels.create(frame.id, [NewLabel("hand", box_at(9.0))], by_hand(frame.revision))
        shutil.copytree(project, left)
    for name in ("project.db", "project.db-wal"):
        (left / name).replace(project / name)
    shutil.rmtree(left)


def test_a_database_copied_beside_a_left_wal_is_not_mixed_with_it(full: Path, tmp_path: Path) -> None:
    shutil.copyfile(full / "project.db", tmp_path / "by_hand.db")
    before = stored_state(full)
    write_and_be_killed(full)
    open_project(full).close()
    write_and_be_killed(full)
    shutil.copyfile(tmp_path / "by_hand.db", full / "project.db")
    with pytest.raises(ProjectError, match=r"with the file project\.db-wal beside it, .* by hand"):
        open_project(full)
    assert verify(full).problems != ()
    repaired = repair(full)
    assert (repaired.path, repaired.lost) == (tmp_path / "hands-repaired", {})
    assert stored_state(repaired.path) == before
    assert verify(repaired.path, deep=True).problems == ()
    assert (full / "project.db-wal").exists()


def test_a_left_wal_of_the_database_itself_is_used(full: Path, tmp_path: Path) -> None:
    for _ in range(2):
        write_and_be_killed(full)
    moved = full.rename(tmp_path / "moved")
    with open_project(moved) as project:
        assert len(project.labels.of_frame(project.frames.of()[4].id)) == 24
    assert verify(moved, deep=True).problems == ()


PLACES = (
    "project.json",
    "project.db",
    "project.db-wal",
    "models",
    "models/view/run/validation/0.jpg",
    "views",
    ".cache/points.json",
)


@pytest.fixture
def sent(tmp_path: Path) -> Path:
    create_project(tmp_path / "projects", "sent", ["person"]).close()
    return tmp_path / "projects" / "sent"


def link(place: Path, target: Path | str) -> None:
    """Puts a link in the place of a file or folder, which moves to the target unless that is missing."""
    if isinstance(target, Path) and place.exists():
        shutil.move(place, target)
    place.parent.mkdir(parents=True, exist_ok=True)
    place.unlink(missing_ok=True)
    place.symlink_to(target)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("is_there", [True, False])
def test_a_project_with_a_link_that_leads_out_is_refused(
    sent: Path, tmp_path: Path, place: str, is_there: bool
) -> None:
    outside = tmp_path / "outside"
    if is_there and not (sent / place).exists():
        outside.mkdir()
    elif not is_there:
        shutil.rmtree(sent / place) if (sent / place).is_dir() else (sent / place).unlink(missing_ok=True)
    link(sent / place, outside)
    before = sorted(tmp_path.rglob("*"))
    assert f"{place}: is a link that leads out of the project" in verify(sent).problems[0]
    with pytest.raises(ProjectError, match=rf"{place}: is a link that leads out of the project.*(remove|put)"):
        open_project(sent)
    assert sorted(tmp_path.rglob("*")) == before
    if place == "project.json" and is_there:
        assert [project.problem is None for project in list_projects(sent.parent)] == [False]


@pytest.mark.parametrize("target", ["../../outside", "view/../../../outside", "loop"])
def test_a_relative_link_or_a_circular_one_is_refused(sent: Path, target: str) -> None:
    link(sent / "models" / "loop", target)
    with pytest.raises(ProjectError, match="models/loop: is a link"):
        open_project(sent)


def test_links_within_a_project_and_to_a_project_are_followed(sent: Path, tmp_path: Path) -> None:
    (sent / "models" / "newest").symlink_to("view/run")
    (sent / "notes").symlink_to(sent / "project.json")
    (tmp_path / "projects" / "same").symlink_to(sent)
    with open_project(tmp_path / "projects" / "same") as project:
        assert project.config.name == "sent"


def test_a_view_that_is_a_link_is_missing_and_replaced(sent: Path, tmp_path: Path) -> None:
    image = np.zeros((4, 4, 3), np.uint8)
    with open_project(sent) as project:
        view = project.views.store(image)
        link(project.views.path(view), tmp_path / "picture.png")
        secret = (tmp_path / "picture.png").read_bytes()
        for read in (project.views.path, project.views.load, project.views.content, project.views.size):
            with pytest.raises(NotFoundError, match="the image is missing"):
                read(view)
        assert project.views.store(image) == view
        assert not project.views.path(view).is_symlink()
        assert project.views.content(view) == secret


STRANGE = {
    "trigger": "CREATE TRIGGER spy AFTER UPDATE ON frames BEGIN DELETE FROM labels; END",
    "view": "CREATE VIEW spy AS SELECT * FROM labels",
}


@pytest.mark.parametrize("kind", STRANGE)
def test_a_project_with_triggers_or_views_of_a_stranger_is_not_opened(sent: Path, kind: str) -> None:
    with closing(sqlite3.connect(sent / "project.db")) as connection:
        connection.execute(STRANGE[kind])
    with pytest.raises(ProjectError, match=rf"has the {kind} 'spy', which does not belong .*project repair"):
        open_project(sent)
    repaired = repair(sent)
    assert verify(repaired.path, deep=True).problems == ()
    open_project(repaired.path).close()
