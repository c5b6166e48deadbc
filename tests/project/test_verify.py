"""A verification finds damaged databases, and with `deep` what differs from the events; neither is copied."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from backup_samples import damage

from annotator.project.backup.make import back_up
from annotator.project.backup.take_in import copy_project
from annotator.project.backup.verify import verify
from annotator.types.errors import ProjectError


def overwritten(project: Path) -> None:
    """Zeroes a page in the middle of the database."""
    database = project / "project.db"
    with database.open("r+b") as file:
        file.seek(4096 * (database.stat().st_size // 4096 // 2))
        file.write(b"\0" * 4096)


def view_changed(how: Callable[[Path], object]) -> Callable[[Path], None]:
    def change(project: Path) -> None:
        (view,) = (project / "views").iterdir()
        how(view)

    return change


SHALLOW: list[tuple[str, Callable[[Path], None], str]] = [
    ("a dropped table", damage("DROP TABLE labels"), "lacks the table labels"),
    ("a renamed table of events", damage("ALTER TABLE events RENAME TO other"), "has the table 'other'"),
    ("a dropped trigger", damage("DROP TRIGGER events_are_not_deleted"), "lacks the trigger events_are_not_deleted"),
    (
        "a foreign trigger",
        damage("CREATE TRIGGER evil AFTER INSERT ON events BEGIN DELETE FROM labels; END"),
        "has the trigger 'evil', which does not belong to a project",
    ),
    ("a foreign table", damage("CREATE TABLE evil_ (a)"), "has the table 'evil_'"),
    ("a changed table", damage("ALTER TABLE frames ADD COLUMN more TEXT"), "the table frames is not that of a project"),
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
            "INSERT INTO labels (uid, frame_id, label, box, source, state, author, time_ns, event_id, track_linked, "
            "box_kind, attributes) VALUES ('x', 1, 'hand', '{}', 'manual', 'accepted', 'a', 1, 1, 0, 'box', '{}')"
        ),
        "labels has rows that the events do not give: x",
    ),
    ("a missing view", view_changed(Path.unlink), "are missing"),
    ("a damaged view", view_changed(lambda view: view.write_bytes(b"")), "are damaged"),
    (
        "a view that is a link",
        view_changed(lambda view: view.symlink_to(view.rename(view.parent.parent / "x"))),
        "no regular files",
    ),
    (
        "a missing detector",
        lambda path: (path / "models/image/one/detector.safetensors").unlink(),
        "files of detectors are missing",
    ),
    (
        "a damaged detector",
        lambda path: (path / "models/image/one/detector.safetensors").write_bytes(b"eno"),
        "weights of detectors are damaged: models/image/one/detector.safetensors",
    ),
    (
        "a detector elsewhere",
        damage("UPDATE models SET path = '../../x.pt' WHERE active"),
        "files of detectors are outside the project: ../../x.pt",
    ),
]


def test_what_a_killed_verification_left_is_removed(
    full: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scratch = tmp_path / "scratch"
    (scratch / ".annotator-verify.0123.unfinished").mkdir(parents=True)
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    assert verify(full, deep=True).problems == ()
    assert list(scratch.iterdir()) == []


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
