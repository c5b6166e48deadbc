"""Our evaluation gives the official evaluators' numbers, and the benchmark detects differences."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import golden
from benchmarks.golden import convention_differences

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


@pytest.mark.shared
def test_curve_counts_equal_those_of_the_devkit(shared: Path) -> None:
    """Compares the number of objects, first matches and samples of every curve, not only the area."""
    from annotator.evaluation.kitti import DIFFICULTIES, evaluate_kitti
    from annotator.formats.kitti_objects import read_kitti_folder
    from annotator.workflows.evaluate import kitti_rows

    folder = shared / "golden"
    with (folder / golden.KITTI).open(newline="") as file:
        rows = [r for r in csv.DictReader(file) if (r["set"], r["evaluator"]) == ("synthetic", "devkit")]
    sides = [read_kitti_folder(folder / f"kitti_synthetic_{name}.zip", scored=name == "det") for name in ("det", "gt")]
    detections, truth = (kitti_rows([side[key] for key in sorted(side)]) for side in sides)
    result = evaluate_kitti(detections, truth)
    assert len(rows) == 36
    for row in rows:
        curves = result.curves[row["class"].capitalize()][golden.METRICS[row["metric"]]]
        curve = curves[DIFFICULTIES.index(row["difficulty"])]
        ours = (curve.objects, curve.found, len(curve.recall))
        assert ours == tuple(int(row[name]) for name in ("n_gt", "n_tp_first_pass", "n_thresholds")), row


@pytest.mark.shared
def test_coordinate_conventions_agree(shared: Path) -> None:
    differences = list(convention_differences(shared / "golden" / golden.CONVENTIONS))
    assert len(differences) == 15
    for difference in differences:
        assert difference.corner_m < 1e-8, difference
        assert difference.center_lidar_m < 1e-7, difference
        assert difference.angle_rad < 1e-8, difference


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
