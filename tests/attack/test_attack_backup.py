"""`kill -9` of backup, restore, copy, repair and upgrade: nothing half is offered, and nothing is lost."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from attacks import Killer, labels_in, require_sound
from store_samples import NEXT, NOW, use_next, version_of

from annotator.cli.main import main
from annotator.project import create_project, open_project
from annotator.project.backup.archive import read_manifest
from benchmarks.backup import fill

LABELS = 900


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A projects folder with `long`, a project of many labels and views; do not change it."""
    root = tmp_path_factory.mktemp("long")
    with create_project(root, "long", ("person",)) as project:
        fill(project, 300, LABELS, 100)
    return root


def test_a_killed_backup_is_whole_or_not_there(killer: Callable[[Path], Killer], long: Path, tmp_path: Path) -> None:
    kills = killer(long)
    file = tmp_path / "backups/long.zip"
    file.parent.mkdir()
    words = ["project", "backup", "long", file, "--projects", kills.folder]
    wanted = labels_in(long / "long")
    restored = 0
    for number, end in enumerate(kills.kills(*words, done=file.unlink)):
        require_sound(kills.folder / "long")
        assert end.was_killed or file.exists()
        if not file.exists():
            # the next backup is not in the way of what is left, and removes it
            kills.whole(*words)
        root = tmp_path / f"restored{number}"
        assert main(["project", "restore", str(file), "--projects", str(root)]) == 0
        require_sound(root / "long")
        assert labels_in(root / "long") == wanted
        restored += 1
        if len(list(file.parent.iterdir())) > 1:  # killed when the file was complete
            file.unlink()
            kills.whole(*words)
        assert [path.name for path in file.parent.iterdir()] == ["long.zip"], "a leftover"
        file.unlink()
    assert restored == kills.times


def test_a_killed_restore_makes_a_whole_project_or_none(
    killer: Callable[[Path], Killer], long: Path, tmp_path: Path
) -> None:
    file = tmp_path / "long.zip"
    assert main(["project", "backup", "long", str(file), "--projects", str(long)]) == 0
    kills = killer(long)
    words = ["project", "restore", file, "again", "--projects", kills.folder]
    again, wanted = kills.folder / "again", labels_in(long / "long")
    for end in kills.kills(*words):
        require_sound(kills.folder / "long")
        assert end.was_killed or again.exists()
        shown = kills.whole("stats", "long", "--projects", kills.folder)
        assert shown.code == 0
        if not again.exists():
            kills.whole(*words)
        require_sound(again)
        assert labels_in(again) == wanted
        assert sorted(path.name for path in kills.folder.iterdir()) == ["again", "long"], "a leftover"


def damage(database: Path) -> None:
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("DROP TRIGGER events_are_not_deleted")


COMMANDS: dict[str, tuple[list[str], Callable[[Path], None] | None]] = {
    "copy": (["project", "copy", "{folder}/long", "new"], None),
    "copy by name": (["project", "copy", "long", "new"], None),
    "repair": (["project", "repair", "long"], None),
    "salvage": (["project", "repair", "long", "new"], damage),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_kill_leaves_nothing_half(killer: Callable[[Path], Killer], long: Path, tmp_path: Path, name: str) -> None:
    words, change = COMMANDS[name]
    template = Path(shutil.copytree(long, tmp_path / "template"))
    if change is not None:
        change(template / "long" / "project.db")
    kills = killer(template)
    words = [word.format(folder=kills.folder) for word in words]
    for _ in kills.kills(*words, "--projects", kills.folder):
        offered = {path.name for path in kills.folder.iterdir() if not path.name.startswith(".")}
        assert offered <= {"long", "new"}
        # what is salvaged stays as it was
        for each in offered - ({"long"} if name == "salvage" else set()):
            with open_project(kills.folder / each) as project:
                assert project.statistics().labels.total == LABELS
            require_sound(kills.folder / each)
        for backup in (kills.folder / ".backups" / "long").glob("*.zip"):
            assert read_manifest(backup).labels == LABELS


def test_a_killed_upgrade_changes_all_or_nothing(
    killer: Callable[[Path], Killer], long: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_next(monkeypatch)
    kills = killer(long)
    kills.migration = NEXT.statements
    versions = set()
    for end in kills.kills("stats", "long", "--projects", kills.folder):
        version = version_of(kills.folder / "long" / "project.db")
        versions.add(version)
        assert version in (NOW, NEXT.version)
        assert end.was_killed or version == NEXT.version
        with open_project(kills.folder / "long") as project:
            assert project.statistics().labels.total == LABELS
        require_sound(kills.folder / "long")
        for backup in (kills.folder / ".backups" / "long").glob("*.zip"):
            assert read_manifest(backup).labels == LABELS
    assert len(versions) == 2, "no kill came before the end of the migration, or none after it"
