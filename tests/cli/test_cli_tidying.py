"""Removing, renaming and copying projects, and recordings that are removed or have moved."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from annotator.cli import output
from annotator.cli.main import main
from annotator.project import WriteContext, open_project
from annotator.project.backup.make import Reason, back_up_automatically
from annotator.types import BoxKind

Run = Callable[..., str]
Labels = Callable[[str], int]
LABELS = 15


@pytest.fixture
def people(own_copy: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recording in the project `room`, with its labels; the current folder is that of the recording."""
    monkeypatch.chdir(tmp_path)
    recording = own_copy("people")
    assert main(["new", "room", "--classes", "person"]) == main(["add", "room", "people"]) == 0
    return recording


@pytest.fixture
def labels(stats: Callable[[str], dict[str, Any]]) -> Labels:
    """`labels("room")`: how many a project has."""
    return lambda project: stats(project)["labels"]["total"]  # type: ignore[no-any-return]


def test_a_removed_recording_comes_back_with_its_labels(people: Path, run: Run, labels: Labels) -> None:
    assert "with 15 labels? Adding it again brings back its labels. Nothing was changed: add --yes" in run(
        "project remove room people", code=2
    )
    assert labels("room") == LABELS
    assert f"bring it back with: annotator add room {people}" in run("project remove room people --yes")
    assert labels("room") == 0
    assert "'people' was removed from the project; `annotator add` brings it back" in run("up room people", code=2)
    assert run("add room people").startswith("people is back in the project, with its labels: 5 frames\nnext:")
    assert labels("room") == LABELS
    assert run("check room").endswith("; 15 labels checked\n"), "which begins with a verification"


def test_the_question_is_asked_at_a_terminal(people: Path, monkeypatch: pytest.MonkeyPatch, labels: Labels) -> None:
    for answer, code in (("\n", 2), ("no\n", 2), ("y\n", 0)):
        stdin = SimpleNamespace(isatty=lambda: True, readline=lambda answer=answer: answer)
        monkeypatch.setattr(
            output, "sys", SimpleNamespace(stdin=stdin, stdout=output.sys.stdout, stderr=output.sys.stderr)
        )
        assert main(["project", "remove", "room", "people"]) == code
        monkeypatch.undo()
        monkeypatch.chdir(people.parent)
    assert labels("room") == 0


def test_a_recording_that_has_only_moved_is_not_added_a_second_time(people: Path, run: Run, labels: Labels) -> None:
    people.rename("archive")
    refused = run("add room archive", code=2)
    assert f"archive: is the recording people, which was at {people}; to keep its labels" in refused
    assert labels("room") == LABELS
    command = refused.split("`")[1].removeprefix("annotator ")
    assert command == "project move room people archive"
    run(command)
    assert "already in the project: 0 new frames" in run("add room archive")
    assert labels("room") == LABELS


def test_another_recording_with_the_same_names_of_frames_is_added(people: Path, generated: Path, run: Run) -> None:
    """Cameras number the frames of all their recordings alike."""
    people.rename("archive")
    assert "added hands: 5 frames" in run(f"add room {generated / 'hands'}")
    # without a fingerprint, as in projects of older versions, the names are all that is known
    with open_project(Path("projects/room")) as project, project.store.write() as connection:
        connection.exec_driver_sql("UPDATE recordings SET fingerprint = NULL")
    shutil.copytree(generated / "hands", "third")
    assert "third: has the frames of the recording people, which was at" in run("add room third", code=2)
    assert "added third: 5 frames" in run("add room third --as-new")


def test_a_project_is_renamed_with_its_backups(people: Path, run: Run, labels: Labels) -> None:
    backups = Path("projects/.backups/room")
    backups.mkdir(parents=True)
    run("new other --classes person")
    assert "exists already; choose another name" in run("project rename room other", code=2)
    assert "is not a valid project name" in run("project rename room Rooms", code=2)
    assert run("project rename room rooms") == "renamed room to rooms\n"
    assert labels("rooms") == LABELS
    with open_project(Path("projects/rooms")) as project:
        assert project.config.name == "rooms"
    assert sorted(path.name for path in Path("projects").iterdir()) == [".backups", "other", "rooms"]
    assert [path.name for path in backups.parent.iterdir()] == ["rooms"]


def test_a_removed_project_can_be_brought_back(people: Path, run: Run, labels: Labels) -> None:
    assert (
        "Remove the project room (recordings: 1, labels: 15)? It is moved to projects/.removed. "
        "Nothing was changed: add --yes"
    ) in run("project remove room", code=2)
    with open_project(Path("projects/room")):
        assert "another process has this project open" in run("project remove room --yes", code=2)
        assert "if it is a server, use its start page" in run("project rename room hall", code=2)
    said = run("project remove room --yes")
    assert "has no project 'room'" in run("stats room", code=2)
    run(said.splitlines()[-1].partition(": annotator ")[2])
    assert labels("room") == LABELS
    # a damaged one can be removed, too
    Path("projects/room/project.db").write_bytes(b"damaged")
    run("project remove room --yes")
    assert len(list(Path("projects/.removed").iterdir())) == 2


def test_a_project_is_copied_with_or_without_its_labels(people: Path, run: Run, labels: Labels) -> None:
    run("calibrate room people --shift 0.1 0 0")
    run("up room people 0 -1 -1")
    said = run("project copy room second")
    assert said.splitlines()[0] == "copied projects/room to projects/second"
    assert labels("second") == LABELS
    assert "copied projects/room to projects/empty without its labels" in run(
        "project copy room empty --without-labels"
    )
    assert labels("empty") == 0
    with open_project(Path("projects/room")) as old, open_project(Path("projects/empty")) as new:
        (before,), (after,) = old.recordings.all(), new.recordings.all()
        assert (after.path, after.frames, after.correction) == (before.path, 5, before.correction)
        assert after.up == pytest.approx(before.up)
        assert (after.correction.shift_m[0], new.boxes.on_images()) == (pytest.approx(0.1), ())
        assert new.config.classes == ("person",)
    assert run("check empty") == "0 warnings; 0 labels checked\n"
    shutil.copytree("projects/room", "room")
    assert "room is both a path and a project; write ./room or projects/room" in run("project copy room third", code=2)
    run("project copy ./room third")


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of projects, with the project `hands`."""
    folder = tmp_path / "projects"
    monkeypatch.setenv("ANNOTATOR_PROJECTS", str(folder))
    monkeypatch.chdir(tmp_path)
    assert main(["new", "hands", "--classes", "hand"]) == 0
    with open_project(folder / "hands") as project:
        project.recordings.add(tmp_path / "take", "rgbd", "take", ["0"], True)
        project.boxes.set_on_image(1, [], BoxKind.BOX, WriteContext(0, "Ada"))
    return folder


def test_back_up_verify_and_restore(root: Path, run: Run) -> None:
    said = run("project backup hands")
    (file,) = root.parent.glob("hands-*.zip")
    assert f"annotator project restore {file.name} NAME" in said
    run("project backup hands bare.zip --models none")
    assert "exists already; choose another name" in run("project", "restore", file.name, code=2)
    assert "0 labels, as of " in run("project restore bare.zip again")
    assert run("project verify again --deep") == "again: sound\n"
    copied = run("project", "copy", root / "again", "taken")
    assert f"reads the recording take from {root.parent / 'take'} (not on" in copied
    assert sorted(path.name for path in root.iterdir()) == ["again", "hands", "taken"]


def test_a_damaged_project_is_found_by_verify_and_by_check(root: Path, run: Run) -> None:
    says = "frames has other values than the events give"
    with closing(sqlite3.connect(root / "hands" / "project.db", isolation_level=None)) as connection:
        connection.execute("UPDATE frames SET finalised = 1")
    for words in ("project verify hands --deep", "check hands"):
        said = run(words, code=1)
        assert says in said and "annotator project restore" in said
        assert says in " ".join(json.loads(run(f"{words} --json", code=1))["problems"])


def test_missing_files_and_the_newest_backup_are_named(root: Path, run: Run) -> None:
    with open_project(root / "hands") as project:
        view = project.views.store(np.zeros((4, 4, 3), np.uint8))
        project.boxes.set_on_view(view, [], BoxKind.BOX, WriteContext(1, "Ada"), frame_id=1)
    assert "lacks" not in run("project repair hands")
    (root / "hands" / "views" / f"{view}.png").unlink()
    lacks = f"the project lacks 1 file of its pseudo-views or detectors: views/{view}.png"
    for words in ("backup hands one.zip", "repair hands again"):
        assert lacks in run(f"project {words}")
    newest = back_up_automatically(root / "hands", Reason.CHANGES).path
    said = run("project verify hands --deep", code=1)
    assert f"a backup such as {newest}, the newest automatic one" in said
