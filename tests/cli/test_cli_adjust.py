"""`annotator up` and `annotator calibrate`, and the frames that are read afterwards."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.cli.main import main
from annotator.geometry.oriented_box import same_box
from annotator.project import BoxRotation, Project, open_project
from annotator.rcv.config import Orientation
from annotator.types import Correction, Frame, Label
from annotator.workflows.frame_source import FrameSource, orientation_for
from annotator.workflows.recorded.adjusting import correct_calibration

LEVEL = np.array([0.0, -1.0, 0.0])


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


def run(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    capsys.readouterr()
    assert main([*words, "--json"]) == 0
    content: dict[str, Any] = json.loads(capsys.readouterr().out)
    return content


def test_up_is_estimated_shown_and_cleared_and_the_boxes_rotation_follows(
    opened: Project, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert first(opened)[0].up is None
    assert orientation_for(BoxRotation.AUTO, first(opened)[0]) is Orientation.FREE
    found = run(capsys, "up", "p", "room", "--estimate")
    true = np.array(json.loads((tmp_path / "gravity.json").read_text())["up"])
    assert np.degrees(np.arccos(np.dot(found["up"], true))) < 2
    assert found["source"] == "project"
    assert found["certainty"] > 0.6
    frame = first(opened)[0]
    assert frame.up == pytest.approx(found["up"])
    assert orientation_for(BoxRotation.AUTO, frame) is Orientation.UPRIGHT
    assert main(["up", "p", "room"]) == 0
    assert "set in the project" in capsys.readouterr().out
    assert run(capsys, "up", "p", "room", "0", "-2", "-0.5")["up"] == pytest.approx([0, -0.970, -0.243], abs=1e-3)
    assert run(capsys, "up", "p", "room", "--clear")["source"] == "unknown"


def test_wrong_directions_and_corrections_are_refused(room: Path, capsys: pytest.CaptureFixture[str]):
    for words in ("1 2", "0 -1 0 --clear", "--estimate --clear", "0 0 0"):
        assert main(["up", "p", "room", *words.split()]) == 2
        assert "three" in capsys.readouterr().err
    for words in ("--turn 0 900 0", "--clear --shift 0 0 1"):
        assert main(["calibrate", "p", "room", *words.split()]) == 2
        assert "give" in capsys.readouterr().err
    (room / "timestamps.csv").unlink()
    assert main(["calibrate", "p", "room", "--time-offset", "0.1"]) == 2
    assert "have no times" in capsys.readouterr().err


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


def test_a_time_offset_shows_the_image_that_is_nearest_in_time(opened: Project, capsys: pytest.CaptureFixture[str]):
    frames = [first(opened, number)[0] for number in range(4)]
    run(capsys, "calibrate", "p", "room", "--time-offset", "0.16")
    late = [first(opened, number)[0] for number in range(4)]
    # the clouds' clock is two frames ahead, so each belongs to an earlier image
    assert [np.array_equal(late[i].rgb, frames[max(0, i - 2)].rgb) for i in range(4)] == [True] * 4
    assert all(np.array_equal(a.cloud.xyz_m, b.cloud.xyz_m) for a, b in zip(late, frames, strict=True))
    run(capsys, "calibrate", "p", "room", "--time-offset", "0.04")
    assert np.array_equal(first(opened, 2)[0].rgb, frames[2].rgb)
    assert run(capsys, "calibrate", "p", "room", "--clear")["time_offset_s"] == 0


def test_adding_a_recording_that_does_not_know_up_says_what_to_do(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    for name, rotation in (("a", "auto"), ("b", "free")):
        assert main(["new", name, "--classes", "person", "--rotation", rotation]) == 0
        capsys.readouterr()
        assert main(["add", name, str(room), "--no-labels"]) == 0
        assert (f"annotator up {name} people --estimate" in capsys.readouterr().out) == (rotation == "auto")


def test_a_correction_by_another_meanwhile_is_not_overwritten(opened: Project, monkeypatch: pytest.MonkeyPatch):
    theirs = Correction(shift_m=(0.0, 0.1, 0.0))

    def late(project: Project, recording: int, *rest: Any) -> int:
        project.adjustments.correct(recording, theirs, "Bob")
        return correct_calibration(project, recording, *rest)

    monkeypatch.setattr("annotator.cli.adjust.correct_calibration", late)
    assert main(["calibrate", "p", "room", "--turn", "3", "0", "0"]) != 0
    assert opened.recordings.all()[0].correction == theirs
