"""`kill -9` of the commands that write, at random moments: nothing acknowledged is lost, nothing half is offered."""

from __future__ import annotations

import random
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mortal import End, Mortal
from sound import content_of, labels_in, require_sound

from annotator.cli.main import main
from annotator.project import create_project, open_project
from annotator.project.event_types import ProposalsReplaced
from annotator.project.migrations import APPLICATION_ID, MIGRATIONS

# 20 kills of a training, on a busy machine
pytestmark = pytest.mark.timeout(3600)
OLD_FRAMES = 100


@pytest.fixture(scope="module")
def mortal(generated: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mortal]:
    """Runs commands and kills them."""
    runner = Mortal(generated / "people", tmp_path_factory.mktemp("mortal") / "log")
    yield runner
    runner.close()


@pytest.fixture(scope="module")
def labelled(generated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A projects folder with `room`: 5 frames with 3D labels and 2D boxes; do not change it."""
    root = tmp_path_factory.mktemp("labelled")
    for words in (
        ["new", "room", "--classes", "person"],
        ["add", "room", str(generated / "people")],
        ["import", "room", "--as-2d"],
    ):
        assert main([*words, "--projects", str(root)]) == 0
    return root


@pytest.fixture(scope="module")
def empty(generated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A projects folder with `room`: 5 frames without labels; do not change it."""
    root = tmp_path_factory.mktemp("empty")
    for words in (["new", "room", "--classes", "person"], ["add", "room", str(generated / "people"), "--no-labels"]):
        assert main([*words, "--projects", str(root)]) == 0
    return root


class Killer:
    """Kills a command at moments that are spread over its run time.

    Attributes:
        killed: how often the kill came before the end.
    """

    def __init__(self, mortal: Mortal, template: Path, folder: Path, times: int, chance: random.Random) -> None:
        self.mortal, self.template, self.folder, self.times, self.chance = mortal, template, folder, times, chance
        self.killed = 0

    def fresh(self) -> Path:
        """A new copy of the template."""
        shutil.rmtree(self.folder, ignore_errors=True)
        return Path(shutil.copytree(self.template, self.folder))

    def whole(self, *words: str | Path) -> End:
        """Runs a command to its end, which must succeed."""
        end = self.mortal.run(*words)
        assert end.code == 0, end
        return end

    def kills(self, *words: str | Path, done: Callable[[], object] = lambda: None) -> Iterator[End]:
        """Kills the command once per iteration, on a fresh copy; at least half the kills must hit.

        Args:
            done: undoes what a whole run has written outside the copy.
        """
        # the first run reads files that later ones find in memory
        for _ in range(2):
            self.fresh()
            seconds = self.whole(*words).seconds
            done()
        for number in range(self.times):
            self.fresh()
            moment = seconds * (number + self.chance.random()) / self.times
            end = self.mortal.run(*words, kill_s=moment)
            assert end.code in (0, -9), end
            self.killed += end.was_killed
            yield end
        assert self.killed * 2 >= self.times, f"only {self.killed} of {self.times} kills came before the end"


@pytest.fixture
def killer(mortal: Mortal, tmp_path: Path, times: int, chance: random.Random) -> Callable[[Path], Killer]:
    """`killer(template)`: kills commands that work on copies of a folder, at `tmp_path / "copy"`."""
    return lambda template: Killer(mortal, template, tmp_path / "copy", times, chance)


def test_a_killed_annotate_stores_whole_frames_and_goes_on(killer: Callable[[Path], Killer], empty: Path) -> None:
    kills = killer(empty)
    words = ["annotate", "room", "--projects", kills.folder, "--engine", "inline"]
    room = kills.folder / "room"
    kills.fresh()
    kills.whole(*words)
    wanted = labels_in(room)
    assert all(wanted.values())
    for end in kills.kills(*words):
        require_sound(room)
        for key, labels in labels_in(room).items():
            assert labels in ([], wanted[key]), f"half a frame {key}: {labels}"
        assert end.was_killed or labels_in(room) == wanted
        kills.whole(*words)
        assert labels_in(room) == wanted


def test_a_killed_training_offers_no_half_detector(killer: Callable[[Path], Killer], labelled: Path) -> None:
    kills = killer(labelled)
    words = ["train", "room", "--projects", kills.folder, "--only", "image", "--image-epochs", "1"]
    words += ["--image-size", "64", "--weights", "never"]
    room = kills.folder / "room"
    before = labels_in(labelled / "room")
    for end in kills.kills(*words):
        require_sound(room)
        assert labels_in(room) == before
        with open_project(room) as project:
            assert len(project.models.all()) <= 1
            assert end.was_killed or project.models.all()
    kills.whole(*words)
    require_sound(room)


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_killed_export_leaves_a_whole_dataset_or_none(
    killer: Callable[[Path], Killer], labelled: Path, tmp_path: Path, overwrite: bool
) -> None:
    kills = killer(labelled)
    out = tmp_path / "datasets" / "people"
    words = ["export", "room", out, "--projects", kills.folder, "--format", "kitti"]
    old = tmp_path / "old"
    kills.fresh()
    kills.whole("export", "room", old, "--projects", kills.folder, "--format", "labelcloud")
    kills.whole(*words)
    wanted, before = content_of(out), content_of(old)
    words += ["--overwrite"]
    for end in kills.kills(*words):
        require_sound(kills.folder / "room")
        found = content_of(out) if out.exists() else None
        # between the two renames of --overwrite there is none; the next export then puts the old one back, or its own
        assert found in (None, before, wanted), sorted(found or ())
        assert end.was_killed or found == wanted
        kills.whole(*words)
        assert content_of(out) == wanted
        assert [path.name for path in out.parent.iterdir()] == ["people"], "a leftover"
        shutil.rmtree(out)
        if overwrite:
            shutil.copytree(old, out)


def test_a_killed_import_stores_whole_frames_and_goes_on(
    killer: Callable[[Path], Killer], empty: Path, labelled: Path, tmp_path: Path
) -> None:
    kills = killer(empty)
    wanted = labels_in(labelled / "room")
    kills.whole("export", "room", tmp_path / "labels", "--projects", labelled, "--format", "openlabel")
    words = ["import", "room", tmp_path / "labels", "--format", "openlabel", "--projects", kills.folder]
    room = kills.folder / "room"
    for end in kills.kills(*words):
        require_sound(room)
        for key, labels in labels_in(room).items():
            assert labels in ([], wanted[key]), f"half a frame {key}: {labels}"
        assert end.was_killed or labels_in(room) == wanted
        kills.whole(*words)
        assert labels_in(room) == wanted


def test_a_killed_backup_is_whole_or_not_there(
    killer: Callable[[Path], Killer], labelled: Path, tmp_path: Path
) -> None:
    kills = killer(labelled)
    file = tmp_path / "backups/room.zip"
    file.parent.mkdir()
    words = ["project", "backup", "room", file, "--projects", kills.folder]
    wanted = labels_in(labelled / "room")
    restored = 0
    for number, end in enumerate(kills.kills(*words, done=file.unlink)):
        require_sound(kills.folder / "room")
        assert end.was_killed or file.exists()
        if not file.exists():
            # the next backup is not in the way of what is left, and removes it
            kills.whole(*words)
        root = tmp_path / f"restored{number}"
        assert main(["project", "restore", str(file), "--projects", str(root)]) == 0
        require_sound(root / "room")
        assert labels_in(root / "room") == wanted
        restored += 1
        assert [path.name for path in file.parent.iterdir()] == ["room.zip"], "a leftover"
        file.unlink()
    assert restored == kills.times


def test_a_killed_restore_makes_a_whole_project_or_none(
    killer: Callable[[Path], Killer], labelled: Path, tmp_path: Path
) -> None:
    file = tmp_path / "room.zip"
    assert main(["project", "backup", "room", str(file), "--projects", str(labelled)]) == 0
    kills = killer(labelled)
    words = ["project", "restore", file, "again", "--projects", kills.folder]
    again, wanted = kills.folder / "again", labels_in(labelled / "room")
    for end in kills.kills(*words):
        require_sound(kills.folder / "room")
        assert end.was_killed or again.exists()
        shown = kills.whole("stats", "room", "--projects", kills.folder)
        assert shown.code == 0
        if not again.exists():
            kills.whole(*words)
        require_sound(again)
        assert labels_in(again) == wanted
        assert sorted(path.name for path in kills.folder.iterdir()) == ["again", "room"], "a leftover"


@pytest.fixture(scope="module")
def old_version(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A projects folder with `old`, a project of database version 1 with many events; do not change it."""
    from store_samples import lost_object, proposal_at

    from annotator.project.event_types import ProposedObject
    from annotator.project.records import ProposalRecord

    root = tmp_path_factory.mktemp("old")
    create_project(root, "old", ["hand"]).close()
    path = root / "old/project.db"
    path.unlink()
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    for statement in MIGRATIONS[0].statements:
        connection.execute(statement)
    connection.execute("PRAGMA user_version = 1")
    connection.execute("INSERT INTO recordings VALUES (1, '/take', 'rgbd', 'take', 1, NULL, 7)")
    record = ProposalRecord.of(proposal_at(steps=3, views=4))
    for number in range(1, OLD_FRAMES + 1):
        passed = ProposalsReplaced(
            objects=(ProposedObject(uid=f"u{number}", proposal=record),), lost=(lost_object(),)
        ).model_dump_json()
        connection.execute("INSERT INTO frames VALUES (?, 1, ?, ?, 1, 0)", (number, f"f{number}", number - 1))
        insert = "INSERT INTO events VALUES (?, ?, NULL, 1, 'proposals_replaced', ?, 'ann', 5, 'auto')"
        connection.execute(insert, (number, number, passed))
    connection.commit()
    connection.close()
    return root


def test_a_killed_migration_changes_all_or_nothing(killer: Callable[[Path], Killer], old_version: Path) -> None:
    kills = killer(old_version)
    words = ["stats", "old", "--projects", kills.folder]
    path = kills.folder / "old/project.db"
    versions = set()
    for end in kills.kills(*words):
        with sqlite3.connect(path) as connection:
            version = connection.execute("PRAGMA user_version").fetchone()[0]
            count = connection.execute("SELECT count(*) FROM events").fetchone()[0]
        connection.close()
        versions.add(version)
        assert version in (1, MIGRATIONS[-1].version)
        assert end.was_killed or version == MIGRATIONS[-1].version
        assert count == OLD_FRAMES
        require_rebuilt(kills.folder / "old")
    assert len(versions) == 2, "no kill came before the end of the migration, or none after it"


def require_rebuilt(path: Path) -> None:
    """The project opens with all its events (version 1 had no table of labels, which a rebuild fills)."""
    with open_project(path) as project:
        assert project.log.rebuild() == OLD_FRAMES
    require_sound(path)
    assert sum(map(len, labels_in(path).values())) == OLD_FRAMES
