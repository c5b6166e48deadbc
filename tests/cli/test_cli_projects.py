"""The commands that create, fill and inspect projects."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from annotator.cli.main import main

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
    assert config["classes"] == ["left hand", "right hand"]
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
    """--projects takes precedence over the environment variable, and that over ./projects; read at call time."""
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


def test_cameras_are_added_by_name_or_all(clouds: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["new", "p", "--classes", "car"]) == 0
    assert main(["add", "p", "clouds", "--look-around", "4", "--camera", "around-090", "around-180"]) == 0
    output = capsys.readouterr().out
    assert "added clouds@around-090: 1 frame (look_around)" in output and "clouds@around-000" not in output
    assert main(["add", "p", "clouds", "--look-around", "4", "--camera", "all"]) == 0
    output = capsys.readouterr().out
    assert output.count("added ") == output.count("already in the project") == 2
    assert main(["add", "p", "clouds", "--look-around", "4", "--camera", "left"]) == 2
    assert "has no virtual camera left; it has around-000" in " ".join(capsys.readouterr().err.split())


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
