"""Our evaluation gives the official evaluators' numbers, and the benchmark detects differences."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import golden

ROOT = Path(__file__).resolve().parents[2]
BOUNDS = {"kitti_max_ap": 1e-3, "sunrgbd_max_map": 1e-6, "iou_max_rel": 1e-6, "conventions_max_px": 1e-3}


@pytest.mark.shared
def test_differences_from_the_official_evaluators(shared: Path) -> None:
    """Measured in a separate process, which is faster: in this one, beartype checks all calls."""
    command = [sys.executable, "-m", "benchmarks.golden", str(shared.resolve() / "golden"), "--json"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    measured = json.loads(done.stdout.splitlines()[-1])
    for part, bound in BOUNDS.items():
        assert measured["compared"][part] > 0
        assert measured[part] < bound, f"{part}: {measured[part]} at {measured['worst'][part]}"
    assert measured["compared"]["kitti_max_ap"] == 270, "every number is compared"


@pytest.fixture
def two_parts(shared: Path, tmp_path: Path) -> Path:
    """A folder with two of the parts."""
    names = (golden.SUNRGBD, golden.SUNRGBD_TRUTH, golden.SUNRGBD_FOUND, golden.PAIRS)
    for name in names:
        shutil.copyfile(shared / "golden" / name, tmp_path / name)
    return tmp_path


@pytest.mark.shared
def test_a_wrong_number_is_found_and_named(two_parts: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    path = two_parts / golden.SUNRGBD
    path.write_text(path.read_text().replace("0.25,chair,0.610", "0.25,chair,0.710"))
    monkeypatch.setattr("sys.argv", ["golden", str(two_parts), "--json"])
    golden.main()
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["sunrgbd_max_map"] == pytest.approx(0.1, abs=1e-3)
    assert said["worst"]["sunrgbd_max_map"] == "chair at 0.25"
    assert said["iou_max_rel"] < 1e-6
    assert (said["kitti_max_ap"], said["conventions_max_px"]) == (None, None), "their files are absent"
