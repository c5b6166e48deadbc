"""The Azure Kinect benchmark: its figures on the real recording,"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from benchmarks import azure_kinect


@pytest.mark.shared
def test_the_real_recording_is_within_the_stated_differences(
    shared: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    folder = shared / "data" / "azure_kinect"
    words = [str(folder / "recording.mkv"), str(folder / "sdk_golden_even.csv")]
    monkeypatch.setattr(sys, "argv", ["azure_kinect", *words, "--json"])
    azure_kinect.main()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) > 3, "a table comes first"
    result = json.loads(lines[-1])
    assert list(result) == ["rows", "max_point_mm", "max_px"]
    assert result["rows"] == 2203
    assert 0 < result["max_point_mm"] < 0.1
    assert 0 < result["max_px"] < 0.05
