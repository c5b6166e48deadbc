"""Rigs on the command line: cameras are named or all added, and inspect says what one sees."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from annotator.cli.main import main


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
