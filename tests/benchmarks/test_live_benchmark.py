"""The live benchmark with perfect detectors instead of a training."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from annotator.project import Project, ProjectSettings, create_project
from annotator.workflows.live import detection
from benchmarks import live, loop


@pytest.fixture
def trained(tmp_path: Path, knowing: Any, monkeypatch: pytest.MonkeyPatch) -> list[loop.Arguments]:
    """Replaces the training; returns the arguments of each call."""
    asked: list[loop.Arguments] = []

    @contextmanager
    def trained_project(args: loop.Arguments, *_: object) -> Iterator[tuple[Project, int]]:
        asked.append(args)
        settings = ProjectSettings(rcv={"max_steps": 2})
        with create_project(tmp_path, f"loop{len(asked)}", ("hand",), settings=settings) as project:
            yield project, 0

    monkeypatch.setattr(loop, "trained_project", trained_project)
    monkeypatch.setattr(live, "_detectors", lambda project, args: knowing("hands"))
    monkeypatch.setattr(live, "WARM_UP_S", 0.5)
    # on a busy machine, frames are far apart in time
    monkeypatch.setattr(detection, "MAX_SEED_AGE_S", 60.0)
    return asked


def test_it_measures_the_whole_pipeline(
    trained: list[loop.Arguments],
    generated: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = [generated / "hands", "--project", tmp_path / "kept", "--warm-start", "--seconds", 0.5, "--json"]
    monkeypatch.setattr(sys, "argv", ["live", *map(str, words)])
    live.main()
    lines = capsys.readouterr().out.splitlines()
    result = json.loads(lines[-1])
    assert len(lines) > 3, "a table comes first"
    assert list(result["stages_ms"]) == ["read", "image", "views", "geometry", "show"]
    assert result["shown"] >= live.LEAST_SHOWN
    assert result["fps"] > 0
    assert result["source_fps"] >= live.LEAST_RATE
    assert result["latency_ms"] >= 0.5 * sum(result["stages_ms"].values())
    assert result["latency_p95_ms"] >= result["latency_ms"]
    assert result["objects_per_frame"] == 2
    assert 0 < result["warm_share"] <= 1
    assert (result["warm_start"], result["backend"], result["image_size_px"]) == (True, "fastest", None)
    (asked,) = trained
    assert (asked.train_dir, asked.project) == (generated / "hands", tmp_path / "kept")
