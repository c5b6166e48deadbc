"""Each benchmark as a program, at a small size: it prints a table, and one JSON object as the last line."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.recordings import open_recording
from annotator.types import Box2D, OrientedBox, Proposal, Quality, Truth
from benchmarks import axes, batch, columns, listing, loop, memory, pseudo_view, slow_loris, up
from benchmarks.memory import growth
from benchmarks.repeating import FOLDERS, lengthen
from benchmarks.report import guarded

ROOT = Path(__file__).resolve().parents[2]
STRATEGIES = ["camera", "eigenvectors", "normals", "consensus"]
LOOP_KEYS = ["frames", "share_with_proposal", "mask_recall", "mask_precision", "mean_iou", "ap25", "ap50", "boxes_2d"]


def program(name: str, *words: str | Path, json_asked: bool = True) -> tuple[dict[str, Any], list[str]]:
    """Runs `python -m benchmarks.NAME`; returns its JSON object and the lines before it."""
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}", *map(str, words), *(["--json"] if json_asked else [])],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    return (json.loads(lines[-1]) if json_asked else {}), lines[:-1]


def in_process(module: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: object) -> Any:
    """Runs a benchmark in this process; returns its JSON object."""
    monkeypatch.setattr(sys, "argv", [module.__name__, *map(str, words), "--json"])
    module.main()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) > 3, "a table comes first"
    return json.loads(lines[-1])


@pytest.fixture
def two_frames(generated: Path, tmp_path: Path) -> Path:
    """The first two frames of the generated people."""
    folder = Path(shutil.copytree(generated / "people", tmp_path / "two"))
    for number in (2, 3, 4):
        for name, suffix in FOLDERS.items():
            (folder / name / f"{number:06d}{suffix}").unlink()
    return folder


def test_axes_compares_all_strategies(
    two_frames: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = in_process(axes, monkeypatch, capsys, two_frames)
    assert list(result) == ["results", "default_axes"]
    assert result["default_axes"] == "consensus"
    assert [row["axes"] for row in result["results"]] == STRATEGIES
    for row in result["results"]:
        assert list(row) == [
            "label",
            "axes",
            "objects",
            "mean_iou",
            "share_50",
            "share_70",
            "false_positives",
            "steps",
            "ms_per_object",
        ]
        assert (row["label"], row["objects"]) == ("person", 6)
        assert 0 < row["mean_iou"] <= 1
        assert 0 <= row["share_70"] <= row["share_50"] <= 1
        assert row["ms_per_object"] > 0
        assert row["false_positives"] == 0, "a perfect detector has no false positives"
        assert 1 <= row["steps"] <= 10
    by_axes = {row["axes"]: row["mean_iou"] for row in result["results"]}
    assert by_axes["consensus"] > 0.97
    assert by_axes["consensus"] > max(by_axes[name] for name in STRATEGIES[:-1])


def test_a_proposal_that_overlaps_no_true_box_is_false() -> None:
    assert axes.false_share([0.0, 0.05, 0.1, 0.9]) == 0.5
    assert axes.false_share([]) == 0.0
    box = OrientedBox.from_parts(np.zeros(3), np.eye(3), np.ones(3))
    far = OrientedBox.from_parts(np.array([9.0, 0.0, 0.0]), np.eye(3), np.ones(3))
    proposals = [
        Proposal("a", 1.0, b, Box2D("a", 0.0, 0.0, 9.0, 9.0), (), Quality(0.0, 1.0, 0.0)) for b in (far, box, box)
    ]
    assert axes.best_ious(proposals, [Truth("a", box)]) == pytest.approx([0, 1, 1])
    assert axes.best_ious(proposals, []) == [0.0] * 3
    assert axes.best_ious([], [Truth("a", box)]) == []


def test_axes_with_jitter_depends_on_the_seed(
    two_frames: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--jitter", "0.02", "--free", "--strategies", "camera"]
    first, again, other = (
        in_process(axes, monkeypatch, capsys, two_frames, *words, "--seed", seed)["results"] for seed in (1, 1, 2)
    )
    assert [row["axes"] for row in first] == ["camera"]
    assert first[0]["mean_iou"] == again[0]["mean_iou"] != other[0]["mean_iou"]
    assert 0.1 < first[0]["mean_iou"] < 0.99


@pytest.mark.shared
def test_boxes_drawn_around_a_turning_person_tell_which_way_is_up(
    shared: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = shared / "data" / "human_turn"
    result = in_process(up, monkeypatch, capsys, path, "--rooms", "1", "--snapshots", "2", "--drawn", "0")
    assert result["recordings"][0]["up"] is None
    (drawn,) = result["drawn"]
    assert drawn["boxes"] == 10 and drawn["proposed"]
    assert drawn["error_deg"] < 8
    assert 3 < drawn["spread_deg"] < 15


@pytest.mark.shared
def test_axes_on_a_kitti_drive(
    shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its first two frames: results by class, and upright boxes by default, since the drive has gravity."""
    source, folder = shared / "data" / "kitti_drive_0005", tmp_path / "drive"
    for name in ("image_02", "velodyne"):
        (folder / name).mkdir(parents=True)
        for path in sorted((source / name).iterdir())[:2]:
            shutil.copyfile(path, folder / name / path.name)
    for name in ("calib.txt", "label_02.txt"):
        shutil.copyfile(source / name, folder / name)
    result = in_process(axes, monkeypatch, capsys, folder, "--strategies", "normals", "consensus")
    labels = {row["label"] for row in result["results"]}
    assert {"Van", "Cyclist"} <= labels
    consensus = {row["label"]: row["mean_iou"] for row in result["results"] if row["axes"] == "consensus"}
    assert min(consensus.values()) > 0.95


def test_pseudo_view_measures_each_combination(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--points", 500, 2000, "--size-px", 64, 96, "--repeats", 2]
    result = in_process(pseudo_view, monkeypatch, capsys, *words)
    assert list(result) == ["results"]
    assert [(row["points"], row["size_px"]) for row in result["results"]] == [
        (500, 64),
        (500, 96),
        (2000, 64),
        (2000, 96),
    ]
    assert all(list(row) == ["points", "size_px", "ms"] and row["ms"] > 0 for row in result["results"])


def test_memory_reports_peaks_and_growth() -> None:
    words = ["--frames", "1", "3", "--different", "2", "--width", "160", "--engine", "local", "--workers", "1"]
    result, lines = program("memory", *words)
    assert list(result) == ["results", "growth_mb_per_1000_frames"]
    assert [row["frames"] for row in result["results"]] == [1, 3]
    peaks = [row["peak_mb"] for row in result["results"]]
    assert all(50 < peak < 2000 for peak in [*peaks, *(row["worker_peak_mb"] for row in result["results"])])
    assert result["growth_mb_per_1000_frames"] == pytest.approx((peaks[1] - peaks[0]) / 2 * 1000)
    assert any("peak MB" in line for line in lines)


def test_batch_compares_engines(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--frames", 4, "--different", 2, "--width", 160, "--steps", 1, "--engines", "local", "--workers", 1]
    result = in_process(batch, monkeypatch, capsys, *words, "--repeats", 2)
    rows = [(row["engine"], row["workers"]) for row in result["results"]]
    assert rows == [("plain", 0), ("one core", 0), ("local", 1)]
    assert all(row["fps"] > 0 and row["start_s"] > 0 for row in result["results"])
    assert all(result["results"][2][name] > 0 for name in ("against_plain", "against_one_core"))
    assert result["ray_against_local"] is None


def test_store_reports_times() -> None:
    options = ("--frames", "30", "--proposed", "4", "--objects", "2", "--reviewed", "8", "--imported", "60")
    result, lines = program("store", *options)
    assert {"add_recording_ms", "write_proposals_median_ms", "queue_teach_ms", "queue_worst_ms"} <= result.keys()
    assert {"reviewed_statistics_ms", "known_statistics_ms"} <= result.keys()
    assert all(took_ms > 0 for name, took_ms in result.items() if name.endswith("_ms"))
    assert result["open_proposals"] == 30 * 3 + 4 * 2
    assert any("statistics" in line for line in lines)


@pytest.mark.parametrize(
    ("frames", "peaks", "expected"),
    [((20, 220), (300.0, 500.0), 1.0), ((10, 20, 30), (5.0, 5.0, 5.0), 0.0), ((7,), (300.0,), math.nan)],
)
def test_memory_growth_is_the_slope_of_the_peaks(
    frames: tuple[int, ...], peaks: tuple[float, ...], expected: float
) -> None:
    assert growth(frames, peaks) == pytest.approx(expected, nan_ok=True)


def test_a_lengthened_recording_repeats_its_frames(generated: Path, tmp_path: Path) -> None:
    lengthen(generated / "people", tmp_path / "long", 7, 3)
    recording, source = open_recording(tmp_path / "long"), open_recording(generated / "people")
    assert recording.keys == tuple(f"{n:06d}" for n in range(7))
    assert (recording.frame(5).rgb == source.frame(2).rgb).all()
    assert not (recording.frame(5).rgb == source.frame(0).rgb).all()


@pytest.mark.slow
def test_loop_reports_scores_and_times(
    generated: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With real trainings of one epoch."""
    words = [generated / "hands", "--epochs", 1, "--views", 16, "--operator", "silhouette"]
    result = in_process(loop, monkeypatch, capsys, *words)
    assert set(LOOP_KEYS) <= set(result)
    assert result["frames"] == 2
    assert result["boxes_2d"] == 3 * 2 * 5
    assert {"label", "train_image", "train_view", "propose"} <= set(result["seconds"])
    assert all(value is None or 0 <= value <= 1 for key, value in result.items() if key in LOOP_KEYS[1:7])


def test_columns_counts_made_up_scans_and_files_that_are_none(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = in_process(columns, monkeypatch, capsys, "--sets", "6")
    assert result["made_up"]["wrong"] == 0
    assert result["made_up"]["read"] >= 5
    assert sum(sum(row.values()) for row in result["made_up"]["by_columns"].values()) == 6
    assert set(result["others_read"].values()) == {0}


def test_listing_recognises_the_data_sets_that_it_creates(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = in_process(listing, monkeypatch, capsys, "--share", "0.002", "--repeats", "1")
    assert {name: row["frames"] for name, row in result.items()} == {
        "kitti_object": 15,
        "sunrgbd_scenes": 21,
        "sunrgbd_extracted": 21,
    }
    assert all(row["format"] == name and row["median_ms"] > 0 for name, row in result.items())


@pytest.mark.slow
def test_slow_loris_measures_clients_beside_half_sent_requests(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = in_process(slow_loris, monkeypatch, capsys, "--connections", 20, "--seconds", 1.0)
    assert result["opened"] >= 20
    assert all(wait["requests"] > 0 for wait in result["waits"].values())
    assert result["p95_s"] > 0 and result["log_bytes"] == 0


@pytest.mark.parametrize(
    ("benchmark", "words"),
    [
        (axes, ["nowhere"]),
        (loop, ["nowhere"]),
        (memory, ["--frames", "0"]),
        (memory, ["--frames", "1", "--different", "0"]),
    ],
)
def test_unusable_input_is_an_error_without_a_traceback(
    benchmark: Any, words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [benchmark.__name__, *words])
    with pytest.raises(SystemExit) as ended:
        guarded(benchmark.main)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert "Traceback" not in said


def test_bags_are_opened_and_read() -> None:
    result, table = program("bags", "--gigabytes", "0.03", "--container", "mcap", "--frames", "2")
    assert (result["bag"], result["frames"]) == ("mcap", 4)
    assert min(result["open_s"], result["frame_median_s"], result["peak_mb"]) > 0
    assert result["peak_mb"] >= result["imported_mb"]
    assert any("frame, s" in line for line in table)
