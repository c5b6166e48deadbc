"""Each benchmark as a program, at a small size: it prints a table, and one JSON object as the last line."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_warm_start import AnyClass

from annotator.workflows.detectors import Detectors
from benchmarks import axes, azure_kinect, batch, cold_start, follow, loop, ratios, step
from benchmarks.batch import FOLDERS
from benchmarks.report import guarded

ROOT = Path(__file__).resolve().parents[2]
STRATEGIES = ["camera", "eigenvectors", "normals", "consensus"]
LOOP_KEYS = ["frames", "share_with_proposal", "mask_recall", "mask_precision", "mean_iou", "ap25", "ap50", "boxes_2d"]


def program(name: str, *words: str | Path) -> tuple[dict[str, Any], list[str]]:
    """Runs `python -m benchmarks.NAME`; returns its JSON object and the lines before it."""
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}", *map(str, words), "--json"],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    return json.loads(lines[-1]), lines[:-1]


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
    assert result["default_axes"] == "consensus"
    assert [row["axes"] for row in result["results"]] == STRATEGIES
    for row in result["results"]:
        assert (row["label"], row["objects"]) == ("person", 6)
        assert row["false_positives"] == 0, "a perfect detector has no false positives"
    by_axes = {row["axes"]: row["mean_iou"] for row in result["results"]}
    assert by_axes["consensus"] > 0.97
    assert by_axes["consensus"] > max(by_axes[name] for name in STRATEGIES[:-1])


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


def test_unusable_input_is_an_error_without_a_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["loop", "nowhere"])
    with pytest.raises(SystemExit) as ended:
        guarded(loop.main)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert "Traceback" not in said


@pytest.mark.shared
def test_the_real_azure_kinect_recording_is_within_the_stated_differences(
    shared: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shared / "data" / "azure_kinect"
    words = [folder / "recording.mkv", folder / "sdk_golden_even.csv"]
    result = in_process(azure_kinect, monkeypatch, capsys, *words)
    assert result["rows"] == 2203
    assert 0 < result["max_point_mm"] < 0.1
    assert 0 < result["max_px"] < 0.05


def test_ratios_above_their_bounds_give_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The times here are simulated."""
    monkeypatch.setattr(
        ratios, "measured", lambda ratio, _: (ratio.work(), ratios.Outcome(ratio.name, 1e9, ratio.most))[1]
    )
    names = [row["name"] for row in ratios.run(ratios.Arguments())["ratios"]]  # type: ignore[attr-defined]
    assert len(names) == 7
    monkeypatch.setattr(sys, "argv", ["ratios", "--json"])
    with pytest.raises(SystemExit) as ended:
        ratios.main()
    assert ended.value.code == 1
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["worse"] == names


def test_all_stages_of_a_step_are_measured_and_each_second_counts_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = in_process(step, monkeypatch, capsys, "--points", 2000, "--repeats", 2, "--size-px", 64)
    assert result["points"] == pytest.approx(2000, rel=0.2)
    rows = {(row["path"], row["step"]): row for row in result["steps"]}
    assert list(rows)[:2] == [("plain", "camera"), ("plain", "wide")]
    assert ("warm", "warm") in rows, "the seed was dropped"
    for row in rows.values():
        assert sum(row["share"].values()) == pytest.approx(1)
        assert row["ms"]["render"] > 0 and row["ms"]["cut"] > 0 and row["detector_ms"] > 0
        assert (row["ms"]["check"] > 0) == (row["step"] == "warm")
        assert (row["ms"]["fit"] > 0) == (row["step"] != "camera")
    assert set(result["per_step_ms"]) == {"plain", "warm"}
    assert all(value > 0 for value in result["per_frame_ms"].values())


@pytest.fixture
def agnostic(
    knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., Any]:
    """Runs a benchmark in this process with perfect boxes without classes; returns its JSON object."""
    monkeypatch.setattr(cold_start, "load_detector", lambda *_: AnyClass(knowing("people").view))
    monkeypatch.setattr(cold_start, "read_trained", lambda _: SimpleNamespace(image_size_px=96))
    return lambda module, *words: in_process(module, monkeypatch, capsys, *words)


@pytest.mark.parametrize("origin", ["projected", "label"])
def test_cold_start_scores_each_class_beside_clusters(
    agnostic: Callable[..., Any], generated: Path, origin: str
) -> None:
    result = agnostic(cold_start, generated / "people", "--image-box", origin, "--every", 2, "--base", "unused")
    person, clusters = sorted(result["results"], key=lambda row: row["label"])
    assert (person["label"], clusters["label"]) == ("person", "person (clusters)")
    assert (person["taught"], person["objects"]) == (0, clusters["objects"])
    assert person["mean_iou"] > 0.8
    # one of the nine stands behind another
    assert person["recall_50"] >= 8 / 9
    assert 0 < clusters["mean_iou"] < person["mean_iou"]


def test_follow_scores_each_track(agnostic: Callable[..., Any], generated: Path) -> None:
    result = agnostic(follow, generated / "people")
    assert len(result["tracks"]) == 3
    for row in result["tracks"]:
        assert (row["label"], row["frames"]) == ("person", 4)
    assert result["mean_iou"] == pytest.approx(np.mean([row["mean_iou"] for row in result["tracks"]]))
    assert result["mean_iou"] > 0.6
    assert result["silent_errors"] == 0
