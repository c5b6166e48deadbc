"""`benchmarks.step` and its stopwatch: all stages occur, and each second counts once."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest

from annotator.types.errors import ConfigError
from benchmarks import step
from benchmarks.step import Stopwatch


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


@pytest.mark.parametrize("wrong", [{"points": 1}, {"size_px": 8}, {"repeats": 0}])
def test_a_number_out_of_its_range_is_an_error(wrong: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong)).replace("_", "-")):
        step.run(step.Arguments(**wrong))


def test_each_second_counts_for_the_innermost_stage() -> None:
    now = [0.0]

    def pass_time(seconds: float) -> None:
        now[0] += seconds

    program = SimpleNamespace(inner=lambda: pass_time(2.0), once=lambda: pass_time(5.0))
    program.outer = lambda: (pass_time(1.0), program.inner(), pass_time(0.5))
    before = program.inner
    watch = Stopwatch(["once"], clock=lambda: now[0])
    with watch.over((program, "outer", "outer", True), (program, "inner", "inner"), (program, "once", "once")):
        program.once()
        program.outer()
        program.outer()
    assert program.inner is before
    assert watch.runs == [[{"inner": 2.0, "outer": 1.5}] * 2]
    assert watch.median_ms("once") == 5000
