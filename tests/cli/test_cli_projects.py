"""The commands that create, fill and inspect projects, and that adjust recordings."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from annotator.cli.main import main
from annotator.geometry.oriented_box import same_box
from annotator.project import BoxRotation, Project, open_project
from annotator.rcv.config import Orientation
from annotator.types import Correction, Frame, Label
from annotator.workflows.frame_source import FrameSource, orientation_for
from annotator.workflows.recorded.adjusting import correct_calibration

WIDTH, HEIGHT = 8, 6


def write_recording(folder: Path, frames: int = 3) -> Path:
    """An RGB-D folder of a wall at 1 m."""
    for name in ("color", "depth"):
        (folder / name).mkdir(parents=True)
    camera = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": [10, 0, 0, 0, 10, 0, 3.5, 2.5, 1]}
    (folder / "camera_intrinsic.json").write_text(json.dumps(camera))
    for number in range(frames):
        add_frame(folder, number)
    return folder


def add_frame(folder: Path, number: int) -> None:
    cv2.imwrite(str(folder / f"color/{number:06d}.png"), np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    cv2.imwrite(str(folder / f"depth/{number:06d}.png"), np.full((HEIGHT, WIDTH), 1000, np.uint16))


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of projects, set by the environment variable."""
    folder = tmp_path / "my projects"
    monkeypatch.setenv("ANNOTATOR_PROJECTS", str(folder))
    monkeypatch.chdir(tmp_path)
    return folder


def stats(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, object]:
    capsys.readouterr()
    assert main(["stats", *words, "--json"]) == 0
    captured = capsys.readouterr()
    assert captured.err == "" and captured.out.count("\n") == 1
    content: dict[str, object] = json.loads(captured.out)
    return content


def test_a_new_project_with_recordings(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = write_recording(tmp_path / "hands take 1")
    assert main(["new", "hands", "--classes", "left hand", "right hand", "--rotation", "free"]) == 0
    config = json.loads((root / "hands" / "project.json").read_text())
    assert config["settings"]["rotation"] == "free"

    assert main(["add", "hands", str(recording), str(write_recording(tmp_path / "b", 2))]) == 0
    assert "added hands take 1: 3 frames (rgbd_folder)" in capsys.readouterr().out
    counts = stats(capsys, "hands")
    assert (counts["recordings"], counts["frames"]) == (2, 5)

    add_frame(recording, 7)
    assert main(["add", "hands", str(recording)]) == 0
    assert "is already in the project: 1 new frame" in capsys.readouterr().out
    assert stats(capsys, "hands")["frames"] == 6

    assert main(["stats", "hands"]) == 0
    assert "recordings" in capsys.readouterr().out


def test_the_projects_option_overrides_the_environment_variable(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["new", "a", "--classes", "x", "--projects", str(tmp_path / "given")]) == 0
    assert (tmp_path / "given/a/project.json").is_file()
    assert main(["new", "b", "--classes", "x"]) == 0
    assert (root / "b/project.json").is_file()
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("ANNOTATOR_PROJECTS")
        assert main(["new", "c", "--classes", "x"]) == 0
    assert (tmp_path / "projects/c/project.json").is_file()


def test_inspect_describes_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = write_recording(tmp_path / "wall")
    (recording / "color/000000.png").unlink()
    assert main(["inspect", str(recording)]) == 0
    said = capsys.readouterr().out
    for text in ("rgbd_folder", "3 (000000 to 000002)", "frame 000000  cannot be read", "8 x 6 px", "48 with colour"):
        assert text in " ".join(said.split(" ")), said

    assert main(["inspect", str(recording), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["frames"] == 3
    assert list(report["broken"]) == ["000000"]
    assert report["frame"]["key"] == "000001"
    assert report["frame"]["points"] == WIDTH * HEIGHT
    assert report["frame"]["nearest_m"] == report["frame"]["farthest_m"] == 1.0
    assert report["has_labels"] is False


@pytest.fixture
def clouds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    rng = np.random.default_rng(0)
    (tmp_path / "clouds").mkdir()
    np.save(tmp_path / "clouds" / "0.npy", rng.uniform([-30, -30, -2], [30, 30, 2], (3000, 3)).astype(np.float32))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "clouds"


def test_inspect_says_how_much_of_a_scan_a_camera_sees(clouds: Path, capsys: pytest.CaptureFixture[str]):
    shares = []
    for camera in ("around-000", "around-120", "around-240"):
        assert main(["inspect", "clouds", "--look-around", "6", "--camera", camera]) == 0
        (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("seen")]
        assert "of 3,000 points" in line
        shares.append(int(line.split("shows ")[1].split()[0].replace(",", "")) / 3000)
    # each image is 80 of 360 degrees wide
    assert all(0.18 < share < 0.25 for share in shares)
    assert main(["inspect", "clouds", "--look-around", "6", "--camera", "all"]) == 2
    assert "--camera all: name one camera" in capsys.readouterr().err
    assert main(["inspect", "clouds", "--look-around", "6"]) == 0
    assert "6 cameras: around-000, around-060" in capsys.readouterr().out


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


def test_a_correction_by_another_meanwhile_is_not_overwritten(opened: Project, monkeypatch: pytest.MonkeyPatch):
    theirs = Correction(shift_m=(0.0, 0.1, 0.0))

    def late(project: Project, recording: int, *rest: Any) -> int:
        project.adjustments.correct(recording, theirs, "Bob")
        return correct_calibration(project, recording, *rest)

    monkeypatch.setattr("annotator.cli.adjust.correct_calibration", late)
    assert main(["calibrate", "p", "room", "--turn", "3", "0", "0"]) != 0
    assert opened.recordings.all()[0].correction == theirs
