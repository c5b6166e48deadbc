"""The benchmark of ratios: a ratio above its bound is reported with exit code 1. The times here are simulated."""

from __future__ import annotations

import json
import sys

import pytest

from benchmarks import ratios
from benchmarks.ratios import Arguments, Outcome, run


def test_ratios_above_their_bounds_give_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(ratios, "measured", lambda ratio, _: (ratio.work(), Outcome(ratio.name, 1e9, ratio.most))[1])
    result = run(Arguments())
    names = [row["name"] for row in result["ratios"]]  # type: ignore[attr-defined]
    assert len(names) == 7
    assert result["worse"] == names
    monkeypatch.setattr(sys, "argv", ["ratios", "--json"])
    with pytest.raises(SystemExit) as ended:
        ratios.main()
    assert ended.value.code == 1
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["worse"] == names
