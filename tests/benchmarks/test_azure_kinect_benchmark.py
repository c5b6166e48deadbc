"""The Azure Kinect benchmark: its figures on the real recording, and unusable rows."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from annotator.types.errors import ConfigError, FormatError
from benchmarks import azure_kinect

HEAD = "u_depth_px,v_depth_px,depth_mm,x_d,y_d,z_d,x_c,y_c,z_c,u_color_px,v_color_px\n"


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


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (HEAD, "has no rows"),
        (HEAD + "1,2,3\n", r"rows\.csv:2: a value is missing or not a number"),
    ],
)
def test_errors_of_unusable_rows_name_the_line(tmp_path: Path, text: str, complaint: str):
    (tmp_path / "rows.csv").write_text(text)
    with pytest.raises(FormatError, match=complaint):
        azure_kinect.read_rows(tmp_path / "rows.csv")


def test_another_recording_is_refused(generated: Path):
    with pytest.raises(ConfigError, match="has the format rgbd_folder; give an Azure Kinect's"):
        azure_kinect.run(azure_kinect.Arguments(generated / "people", generated / "rows.csv"))
