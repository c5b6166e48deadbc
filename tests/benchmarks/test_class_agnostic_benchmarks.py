"""Boxes of unseen classes: `cold_start` and `follow`, with perfect boxes without classes."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_warm_start import AnyClass

from annotator.workflows.detectors import Detectors
from benchmarks import cold_start, follow

SIZE_PX = 96


@pytest.fixture
def run(
    knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., Any]:
    """Runs a benchmark in this process with perfect boxes; returns its JSON object."""

    def program(module: ModuleType, *words: object) -> Any:
        detector = AnyClass(knowing("people").view)
        monkeypatch.setattr(cold_start, "load_detector", lambda *_: detector)
        monkeypatch.setattr(cold_start, "read_trained", lambda _: SimpleNamespace(image_size_px=SIZE_PX))
        weights = [] if module is follow else ["--base", "unused"]
        monkeypatch.setattr(sys, "argv", [module.__name__, *map(str, words), *weights, "--json"])
        module.main()
        return json.loads(capsys.readouterr().out.splitlines()[-1])

    return program


@pytest.mark.parametrize("origin", ["projected", "label"])
def test_cold_start_scores_each_class_beside_clusters(run: Callable[..., Any], generated: Path, origin: str) -> None:
    result = run(cold_start, generated / "people", "--image-box", origin, "--every", 2)
    person, clusters = sorted(result["results"], key=lambda row: row["label"])
    assert list(person) == [
        "label", "taught", "objects", "mean_iou", "recall_25", "recall_50", "recall_70", "seconds_training"
    ]  # fmt: skip
    assert (person["label"], clusters["label"]) == ("person", "person (clusters)")
    assert (person["taught"], person["objects"]) == (0, clusters["objects"])
    assert person["mean_iou"] > 0.8
    assert person["recall_50"] == 1
    assert 0 < clusters["mean_iou"] < person["mean_iou"]


def test_follow_scores_each_track(run: Callable[..., Any], generated: Path) -> None:
    result = run(follow, generated / "people")
    assert list(result) == ["tracks", "mean_iou", "silent_errors", "marked"]
    assert len(result["tracks"]) == 3
    for row in result["tracks"]:
        assert list(row) == ["label", "frames", "mean_iou", "share_50", "stopped_at", "stopped_because"]
        assert (row["label"], row["frames"]) == ("person", 4)
    assert result["mean_iou"] == pytest.approx(np.mean([row["mean_iou"] for row in result["tracks"]]))
    assert result["mean_iou"] > 0.6
    assert result["silent_errors"] == 0
