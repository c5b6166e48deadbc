"""`benchmarks.step` and its stopwatch: all stages occur, and each second counts once."""

from __future__ import annotations

import sys

import pytest

from benchmarks import step


def test_all_stages_are_measured(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["step", "--points", "2000", "--repeats", "1", "--size-px", "64", "--json"])
    step.main()
    assert len(capsys.readouterr().out.splitlines()) > 10
    result = step.run(step.Arguments(points=2000, repeats=2, size_px=64))
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
