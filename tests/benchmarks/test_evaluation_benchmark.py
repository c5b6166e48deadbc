"""The benchmark of evaluations, small: its files can be evaluated, and its figures are seconds."""

from __future__ import annotations

import json

import pytest

from annotator.types.errors import ConfigError
from benchmarks import evaluation


def said(words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> dict[str, float]:
    monkeypatch.setattr("sys.argv", ["evaluation", *words, "--json"])
    evaluation.main()
    found: dict[str, float] = json.loads(capsys.readouterr().out.splitlines()[-1])
    return found


def test_it_measures_both(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--kitti-frames", "5", "--sunrgbd-frames", "5", "--repeat", "1"]
    found = said(words, monkeypatch, capsys)
    assert list(found) == ["kitti_s", "sunrgbd_s"]
    assert all(0 < seconds < 30 for seconds in found.values())


def test_nothing_cannot_be_measured(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match="must be 1 or more"):
        said(["--repeat", "0"], monkeypatch, capsys)
