"""Damage of the events and tables is reported; a repair makes the state anew, or saves what is readable."""

from __future__ import annotations

import json
import sqlite3
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from scipy.spatial.transform import RigidTransform
from sqlalchemy.exc import IntegrityError
from store_samples import box_at, by_hand, damage, revised, some_boxes, stored_state

from annotator.project import NewLabel, Project, StoredRecording, open_project
from annotator.project.backup.make import back_up
from annotator.project.backup.repair import repair
from annotator.project.backup.take_in import copy_project
from annotator.project.backup.verify import verify
from annotator.project.changes import StillMade
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind
from annotator.project.database.schema import columns_of
from annotator.project.recordings import SharedCloud
from annotator.project.records import FramePose
from annotator.types import BoxKind
from annotator.types.errors import ProjectError

# The place of the box in a row of a label without its id.
BOX = columns_of("labels").index("box")


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
    ("a dropped trigger", damage("DROP TRIGGER events_are_not_deleted"), "lacks the trigger events_are_not_deleted"),
    ("a foreign table", damage("CREATE TABLE evil_ (a)"), "has the table 'evil_'"),
    ("a missing row", damage("DELETE FROM runs;;DELETE FROM recordings"), "refers to a missing row of recordings"),
    ("an overwritten page", overwritten, "project.db: "),
]
DEEP: list[tuple[str, Callable[[Path], None], str]] = [
    ("a changed label", damage("UPDATE labels SET state = 'rejected'"), "labels has other values than the events give"),
    ("a removed label", damage("DELETE FROM labels"), "labels lacks rows that the events give"),
    (
        "an added label",
        damage(
            "INSERT INTO labels (uid, frame_id, moment_id, class_id, box, source, state, author, time_ns, "
            "track_linked, box_kind, attributes, values_set) "
            "VALUES ('x', 1, 1, 1, '{}', 'manual', 'accepted', 'a', 1, 0, 'box', '{}', 0)"
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
        "are missing, or no regular files: models/image/one/detector.safetensors",
    ),
    (
        "a damaged detector",
        lambda path: (path / "models/image/one/detector.safetensors").write_bytes(b"eno"),
        "are damaged: models/image/one/detector.safetensors",
    ),
    (
        "a detector elsewhere",
        damage("UPDATE models SET path = '../../x.pt' WHERE active"),
        "refers to files outside the project: ../../x.pt",
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


def test_repair_makes_the_state_anew(full: Path) -> None:
    before = stored_state(full)
    damage("UPDATE labels SET state = 'rejected'")(full)
    repaired = repair(full)
    assert (repaired.path, repaired.lost) == (full.with_name("hands-repaired"), {})
    assert stored_state(repaired.path) == before
    assert verify(repaired.path, deep=True).problems == ()


def test_repair_saves_what_is_readable_of_a_damaged_database(project: Project, recording: StoredRecording) -> None:
    for frame in project.frames.of():
        for revision in range(20):
            project.labels.create(frame.id, [NewLabel("hand", box_at(1.0 * revision))], by_hand(revision))
    project.close()
    database = project.path / "project.db"
    with closing(sqlite3.connect(database)) as connection:
        tables = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'events'").fetchall()
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
    before, whole = database.read_bytes(), stored_state(project.path)
    leaves = [page for page in range(1, pages) if b"label_created" in before[page * 4096 : page * 4096 + 4096]]
    assert tables and len(leaves) > 3
    with database.open("r+b") as file:  # one page of events, not the labels
        file.seek(leaves[len(leaves) // 2] * 4096)
        file.write(b"\0" * 4096)
    damaged = database.read_bytes()
    repaired = repair(project.path, "saved")
    assert repaired.lost and repaired.restored
    assert database.read_bytes() == damaged
    assert verify(repaired.path, deep=True).problems == ()
    saved = stored_state(repaired.path)
    boxes = [sorted(str(row[BOX]) for row in state["labels"]) for state in (saved, whole)]
    assert boxes[0] == boxes[1]


def test_repair_of_something_that_is_no_database_says_so(full: Path) -> None:
    (full / "project.db").write_bytes(b"nothing" * 1000)
    with pytest.raises(ProjectError, match="nothing can be read"):
        repair(full)
    assert {path.name for path in full.parent.iterdir()} == {"hands"}


def latest_pass(project: Path) -> object:
    with open_project(project) as opened:
        found = opened.proposals.latest(opened.frames.of()[0].id)
    return found and [(label, box.pose.tolist(), box.size_m.tolist(), score) for label, box, score in found]


@contextmanager
def without_triggers(project: Path) -> Iterator[sqlite3.Connection]:
    """Lets a block change the events, which triggers forbid."""
    with closing(sqlite3.connect(project / "project.db")) as connection, connection:
        triggers = connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'").fetchall()
        for name, _ in triggers:
            connection.execute(f"DROP TRIGGER {name}")
        yield connection
        for _, sql in triggers:
            connection.execute(sql)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda rows: [[*row[:2], None, row[3]] for row in rows], id="a label that is there already"),
        pytest.param(lambda rows: [[*row[:3], {"state": "odd"}] for row in rows], id="a state that there is not"),
        pytest.param(lambda rows: [[*row[:3], {"state": ["odd"]}] for row in rows], id="a value of another kind"),
        pytest.param(lambda rows: [[*row[:3], "odd"] for row in rows], id="no row"),
        pytest.param(lambda rows: [[*row[:3], {}] for row in rows], id="no columns"),
        pytest.param(lambda rows: [["events", *row[1:]] for row in rows], id="a table that is not audited"),
        pytest.param(
            lambda rows: [[*row[:3], {'hidden" = 1, "state': "rejected"}] for row in rows], id="a column that is SQL"
        ),
    ],
)
def test_an_event_that_cannot_be_applied_is_named_and_left_out(full: Path, change: Callable[[Any], Any]) -> None:
    whole, found = stored_state(full), latest_pass(full)
    with without_triggers(full) as connection:
        newest = "SELECT id, rows FROM events WHERE kind = 'label_accepted' ORDER BY id DESC LIMIT 1"
        number, rows = connection.execute(newest).fetchone()
        changed = json.dumps(change(json.loads(rows)))
        connection.execute("UPDATE events SET rows = ? WHERE id = ?", (changed, number))
    assert "the events contradict each other" in " ".join(verify(full, deep=True).problems)
    repaired = repair(full, "saved")
    assert repaired.lost == {"events": 1} and repaired.restored == 1
    assert verify(repaired.path, deep=True).problems == ()
    assert stored_state(repaired.path)["labels"] == whole["labels"]
    assert latest_pass(repaired.path) == found is not None


DELETED = {"all events": "1", "every third": "id % 3 = 1", "the last ones": "id > (SELECT max(id) - 3 FROM events)"}


@pytest.mark.parametrize("which", DELETED)
def test_labels_whose_events_were_deleted_are_taken_from_the_tables(full: Path, which: str) -> None:
    whole = stored_state(full)
    assert whole["labels"]
    with without_triggers(full) as connection:
        count = connection.execute(f"DELETE FROM events WHERE {DELETED[which]}").rowcount
    assert count
    assert "refers to a missing row of events" in " ".join(verify(full, deep=True).problems)
    repaired = repair(full, "saved")
    assert repaired.lost["events"] >= count and repaired.restored
    assert verify(repaired.path, deep=True).problems == ()
    saved = stored_state(repaired.path)
    assert sorted(str(row[BOX]) for row in saved["labels"]) == sorted(str(row[BOX]) for row in whole["labels"])
    assert {table: len(rows) for table, rows in saved.items()} == {table: len(rows) for table, rows in whole.items()}


def test_estimated_poses_are_saved_with_what_stands_still_by_them(project: Project, tmp_path: Path) -> None:
    recording = project.recordings.add(tmp_path / "take", "rgbd", "take", ["0", "1"], True).id
    frame = next(iter(project.frames.of([recording]))).id
    steps = [RigidTransform.from_translation([float(n), 0.0, 0.0]) for n in range(2)]
    poses = [FramePose.of(str(n), T, 0.9, 0.0, 0.5) for n, T in enumerate(steps)]
    project.estimates.keep(recording, poses, "ann")
    new = NewLabel("hand", box_at(), track_id=1)
    project.labels.create(frame, [new], revised(project, frame))
    project.log.append(frame, [StillMade(uid=new.uid)], revised(project, frame))
    project.close()
    with without_triggers(project.path) as connection:
        connection.execute("DELETE FROM events")
    repaired = repair(project.path, "saved")
    assert repaired.lost["states"] == 0
    with open_project(repaired.path) as saved:
        assert saved.estimates.of(recording) == tuple(poses) and len(saved.stills.of(recording)) == 1
        assert len(saved.stills.poses(recording)) == 2


def test_a_truncated_database_is_read_as_far_as_it_goes(full: Path) -> None:
    database = full / "project.db"
    with open_project(full) as project:  # so that the last pages have no table's beginning
        project.boxes.set_on_image(project.frames.of()[3].id, some_boxes(1000), BoxKind.BOX, by_hand())
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    whole = len(stored_state(full)["labels"])
    size = database.stat().st_size
    with database.open("r+b") as file:
        file.truncate(size - 2 * 4096)
    repaired = repair(full, "saved")
    assert repaired.events
    assert len(stored_state(repaired.path)["labels"]) == whole
    assert database.stat().st_size == size - 2 * 4096


def test_a_frame_that_has_joined_the_moment_of_a_later_one_is_kept(project: Project, tmp_path: Path) -> None:
    clouds = {key: SharedCloud(key, RigidTransform.identity()) for key in ("a", "b")}
    for number, known in enumerate(({"b": clouds["b"]}, clouds)):
        options = json.dumps({"camera": f"c{number}"})
        project.recordings.add(tmp_path, "rgbd", "rig", ["a", "b"], True, options=options, clouds=known)
    project.recordings.rescan(1, ["a", "b"], clouds=clouds)
    assert [frame.moment_id for frame in project.frames.of()] == [3, 2, 3, 2]
    project.labels.create(1, [NewLabel("hand", box_at())], by_hand())
    repaired = repair(project.path)
    assert not repaired.lost and len(stored_state(repaired.path)["labels"]) == 1
    with open_project(copy_project(project.path, tmp_path, "copy", labels=False)) as copy:
        assert [frame.moment_id for frame in copy.frames.of()] == [1, 2, 1, 2]


def test_changes_of_classes_come_before_all_events_of_a_copy_without_labels(
    project: Project, frame: int, tmp_path: Path
) -> None:
    side = Attribute(name="side", kind=AttributeKind.CHOICE, choices=("left", "right"))
    project.change_classes(edit.PutAttribute(attribute=side), "ann")
    for n in range(9):
        project.labels.create(frame, [NewLabel("hand", box_at(n))], by_hand(n))
    project.change_classes(edit.RenameAttribute(name="side", new="hand_side"), "ann")
    project.change_classes(edit.PutAttribute(attribute=side), "ann")
    with open_project(copy_project(project.path, tmp_path, "copy", labels=False)) as copy:
        made = copy.labels.create(frame, [NewLabel("hand", box_at(), attributes={"side": "left"})], by_hand())
        copy.labels.set_attributes(frame, made.uids[0], {"side": "right"}, by_hand(1))
        copy.history.undo("ann")
        assert copy.labels.get(made.uids[0]).label.attributes == {"side": "left"}


def test_a_damaged_event_is_reported(project: Project, frame: int) -> None:
    connection = sqlite3.connect(project.path / "project.db")
    connection.execute(
        "INSERT INTO events (frame_id, revision, kind, rows, author, time_ns, source) "
        "VALUES (?, 1, 'frame_finalised', ?, 'ann', 5, 'manual')",
        (frame, zlib.compress(b"{}" * 1000)[:-5]),
    )
    connection.commit()
    connection.close()
    with pytest.raises(ProjectError, match=r"event of the project is damaged .* restore it from a backup"):
        project.log.of_frame(frame)


@pytest.mark.parametrize(
    ("table", "column", "damage"),
    [("labels", "box", '{"center_m": [1'), ("labels", "box", "{}"), ("recordings", "up", "[1")],
)
def test_a_damaged_row_is_reported(project: Project, frame: int, table: str, column: str, damage: str) -> None:
    project.labels.create(frame, [NewLabel("hand", box_at(0.0))], by_hand(0))
    with project.store.write() as connection:
        connection.exec_driver_sql(f"UPDATE {table} SET {column} = ?", (damage,))
    with pytest.raises(ProjectError, match=r"a row of the project's database is damaged .* restore it from a backup"):
        _ = project.labels.of_frame(frame), project.recordings.all()


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE events SET author = 'eve'",
        "DELETE FROM events",
        "INSERT OR REPLACE INTO events SELECT * FROM events",
    ],
)
def test_events_are_append_only(project: Project, frame: int, statement: str) -> None:
    project.boxes.set_on_image(frame, [], BoxKind.BOX, by_hand())
    before = list(project.log.since())
    with pytest.raises(IntegrityError, match="append-only"), project.store.write() as connection:
        connection.exec_driver_sql(statement)
    assert list(project.log.since()) == before
