"""Commands on projects: made, filled, renamed, copied, removed, backed up; recordings that have moved."""

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
from rgbd_samples import wall, write_rgbd

from annotator.cli import output
from annotator.cli.main import main
from annotator.geometry.oriented_box import same_box
from annotator.project import BoxRotation, Project, WriteContext, open_project
from annotator.project.backup.make import Reason, back_up_automatically
from annotator.rcv.config import Orientation
from annotator.types import BoxKind, Correction, Frame, Label
from annotator.workflows.frame_source import FrameSource, orientation_for
from annotator.workflows.recorded.adjusting import correct_calibration

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
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of projects, with the project `hands`."""
    folder = tmp_path / "projects"
    monkeypatch.setenv("ANNOTATOR_PROJECTS", str(folder))
    monkeypatch.chdir(tmp_path)
    assert main(["new", "hands", "--classes", "hand"]) == 0
    with open_project(folder / "hands") as project:
        project.recordings.add(tmp_path / "take", "rgbd", "take", ["0"], True)
        project.boxes.set_on_image(1, [], BoxKind.BOX, WriteContext(0, "Ada"))
    return folder


def test_back_up_verify_and_restore(kept: Path, run: Run) -> None:
    said = run("project backup hands")
    (file,) = kept.parent.glob("hands-*.zip")
    assert f"annotator project restore {file.name} NAME" in said
    run("project backup hands bare.zip --models none")
    assert "exists already; choose another name" in run("project", "restore", file.name, code=2)
    assert "0 labels, as of " in run("project restore bare.zip again")
    assert run("project verify again --deep") == "again: sound\n"
    copied = run("project", "copy", kept / "again", "taken")
    assert f"reads the recording take from {kept.parent / 'take'} (not on" in copied
    assert sorted(path.name for path in kept.iterdir()) == ["again", "hands", "taken"]


def test_a_damaged_project_is_found_by_verify_and_by_check(kept: Path, run: Run) -> None:
    says = "frames has other values than the events give"
    with closing(sqlite3.connect(kept / "hands" / "project.db", isolation_level=None)) as connection:
        connection.execute("UPDATE frames SET finalised = 1")
    for words in ("project verify hands --deep", "check hands"):
        said = run(words, code=1)
        assert says in said and "annotator project restore" in said
        assert says in " ".join(json.loads(run(f"{words} --json", code=1))["problems"])


def test_missing_files_and_the_newest_backup_are_named(kept: Path, run: Run) -> None:
    with open_project(kept / "hands") as project:
        view = project.views.store(np.zeros((4, 4, 3), np.uint8))
        project.boxes.set_on_view(view, [], BoxKind.BOX, WriteContext(1, "Ada"), frame_id=1)
    assert "lacks" not in run("project repair hands")
    (kept / "hands" / "views" / f"{view}.png").unlink()
    lacks = f"the project lacks 1 file of its pseudo-views or detectors: views/{view}.png"
    for words in ("backup hands one.zip", "repair hands again"):
        assert lacks in run(f"project {words}")
    newest = back_up_automatically(kept / "hands", Reason.CHANGES).path
    said = run("project verify hands --deep", code=1)
    assert f"a backup such as {newest}, the newest automatic one" in said


def test_a_new_project_with_recordings(
    root: Path, tmp_path: Path, run: Run, stats: Callable[[str], dict[str, Any]]
) -> None:
    recording = write_rgbd(tmp_path / "hands take 1", wall(3))
    assert main(["new", "hands", "--classes", "left hand", "right hand", "--rotation", "free"]) == 0
    config = json.loads((root / "hands" / "project.json").read_text())
    assert config["settings"]["rotation"] == "free"

    added = run("add", "hands", recording, write_rgbd(tmp_path / "b", wall(2)))
    assert "added hands take 1: 3 frames (rgbd_folder)" in added
    counts = stats("hands")
    assert (counts["recordings"], counts["frames"]) == (2, 5)

    write_rgbd(recording, wall(4))
    assert "is already in the project: 1 new frame" in run("add", "hands", recording)
    assert stats("hands")["frames"] == 6

    assert "recordings" in run("stats hands")


def test_the_projects_option_overrides_the_environment_variable(root: Path, tmp_path: Path) -> None:
    assert main(["new", "a", "--classes", "x", "--projects", str(tmp_path / "given")]) == 0
    assert (tmp_path / "given/a/project.json").is_file()
    assert main(["new", "b", "--classes", "x"]) == 0
    assert (root / "b/project.json").is_file()
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("ANNOTATOR_PROJECTS")
        assert main(["new", "c", "--classes", "x"]) == 0
    assert (tmp_path / "projects/c/project.json").is_file()


def test_inspect_describes_a_recording(tmp_path: Path, run: Run) -> None:
    recording = write_rgbd(tmp_path / "wall", wall(3))
    (recording / "color/000000.png").unlink()
    said = run("inspect", recording)
    for text in ("rgbd_folder", "3 (000000 to 000002)", "frame 000000  cannot be read", "8 x 6 px", "48 with colour"):
        assert text in " ".join(said.split(" ")), said

    report = json.loads(run("inspect", recording, "--json"))
    assert report["frames"] == 3
    assert list(report["broken"]) == ["000000"]
    assert report["frame"]["key"] == "000001"
    assert report["frame"]["points"] == 48
    assert report["frame"]["nearest_m"] == report["frame"]["farthest_m"] == 1.0
    assert report["has_labels"] is False


@pytest.fixture
def clouds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    rng = np.random.default_rng(0)
    (tmp_path / "clouds").mkdir()
    np.save(tmp_path / "clouds" / "0.npy", rng.uniform([-30, -30, -2], [30, 30, 2], (3000, 3)).astype(np.float32))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "clouds"


def test_inspect_says_how_much_of_a_scan_a_camera_sees(clouds: Path, run: Run):
    shares = []
    for camera in ("around-000", "around-120", "around-240"):
        said = run(f"inspect clouds --look-around 6 --camera {camera}")
        (line,) = [line for line in said.splitlines() if line.startswith("seen")]
        assert "of 3,000 points" in line
        shares.append(int(line.split("shows ")[1].split()[0].replace(",", "")) / 3000)
    # each image is 80 of 360 degrees wide
    assert all(0.18 < share < 0.25 for share in shares)
    assert "--camera all: name one camera" in run("inspect clouds --look-around 6 --camera all", code=2)
    assert "6 cameras: around-000, around-060" in run("inspect clouds --look-around 6")


@pytest.fixture
def room(own_copy: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A generated recording with times and labels, added to the project "p" without its gravity."""
    monkeypatch.setenv("ANNOTATOR_PROJECTS", str(tmp_path / "projects"))
    folder = own_copy("people")
    keys = sorted(path.stem for path in (folder / "color").iterdir())
    lines = [f"{key},{number * 100_000_000}\n" for number, key in enumerate(keys)]
    (folder / "timestamps.csv").write_text("key,timestamp_ns\n" + "".join(lines))
    (folder / "gravity.json").rename(tmp_path / "gravity.json")
    assert main(["new", "p", "--classes", "person"]) == 0
    assert main(["add", "p", str(folder), "--name", "room"]) == 0
    return folder


@pytest.fixture
def opened(room: Path, tmp_path: Path) -> Project:
    return open_project(tmp_path / "projects" / "p")


def first(project: Project, number: int = 0) -> tuple[Frame, tuple[Label, ...]]:
    stored = project.frames.of()[number]
    return FrameSource(project).read(stored), tuple(each for each in project.labels.of_frame(stored.id))


def test_up_is_estimated_shown_and_cleared_and_the_boxes_rotation_follows(opened: Project, tmp_path: Path, run: Run):
    assert first(opened)[0].up is None
    assert orientation_for(BoxRotation.AUTO, first(opened)[0]) is Orientation.FREE
    found = json.loads(run("up p room --estimate --json"))
    true = np.array(json.loads((tmp_path / "gravity.json").read_text())["up"])
    assert np.degrees(np.arccos(np.dot(found["up"], true))) < 2
    assert found["source"] == "project"
    assert found["certainty"] > 0.6
    frame = first(opened)[0]
    assert frame.up == pytest.approx(found["up"])
    assert orientation_for(BoxRotation.AUTO, frame) is Orientation.UPRIGHT
    assert "set in the project" in run("up p room")
    given = json.loads(run("up p room 0 -2 -0.5 --json"))
    assert given["up"] == pytest.approx([0, -0.970, -0.243], abs=1e-3)
    assert json.loads(run("up p room --clear --json"))["source"] == "unknown"


def test_labels_that_are_imported_after_a_correction_are_where_the_cloud_is(
    opened: Project, room: Path, tmp_path: Path
):
    assert main(["new", "q", "--classes", "person"]) == 0
    assert main(["add", "q", str(room), "--name", "room", "--no-labels"]) == 0
    for name in ("p", "q"):
        assert main(["calibrate", name, "room", "--turn", "3", "0", "0", "--shift", "0", "0.1", "0"]) == 0
    assert main(["add", "q", str(room)]) == 0
    with open_project(tmp_path / "projects" / "q") as late:
        pairs = zip(opened.labels.select(), late.labels.select(), strict=True)
        assert all(same_box(a.label.box, b.label.box) for a, b in pairs)


def test_a_time_offset_shows_the_image_that_is_nearest_in_time(opened: Project, run: Run):
    frames = [first(opened, number)[0] for number in range(4)]
    run("calibrate p room --time-offset 0.16")
    late = [first(opened, number)[0] for number in range(4)]
    # the clouds' clock is two frames ahead, so each belongs to an earlier image
    assert [np.array_equal(late[i].rgb, frames[max(0, i - 2)].rgb) for i in range(4)] == [True] * 4
    assert all(np.array_equal(a.cloud.xyz_m, b.cloud.xyz_m) for a, b in zip(late, frames, strict=True))
    run("calibrate p room --time-offset 0.04")
    assert np.array_equal(first(opened, 2)[0].rgb, frames[2].rgb)
    assert json.loads(run("calibrate p room --clear --json"))["time_offset_s"] == 0


def test_a_correction_by_another_meanwhile_is_not_overwritten(opened: Project, monkeypatch: pytest.MonkeyPatch):
    theirs = Correction(shift_m=(0.0, 0.1, 0.0))

    def late(project: Project, recording: int, *rest: Any) -> int:
        project.adjustments.correct(recording, theirs, "Bob")
        return correct_calibration(project, recording, *rest)

    monkeypatch.setattr("annotator.cli.adjust.correct_calibration", late)
    assert main(["calibrate", "p", "room", "--turn", "3", "0", "0"]) != 0
    assert opened.recordings.all()[0].correction == theirs
