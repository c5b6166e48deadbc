"""The commands that create, fill and inspect projects, and that adjust recordings."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rgbd_samples import wall, write_rgbd

from annotator.cli.main import main
from annotator.geometry.oriented_box import same_box
from annotator.project import BoxRotation, Project, open_project
from annotator.rcv.config import Orientation
from annotator.types import Correction, Frame, Label
from annotator.workflows.frame_source import FrameSource, orientation_for
from annotator.workflows.recorded.adjusting import correct_calibration

Run = Callable[..., str]


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
