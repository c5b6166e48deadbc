"""The benchmark of evaluations, at a small size."""

from __future__ import annotations

import json

import pytest

from annotator.types.errors import ConfigError
from benchmarks import evaluation


def benchmark_result(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> dict[str, float]:
    monkeypatch.setattr("sys.argv", ["evaluation", *words, "--json"])
    evaluation.main()
    result: dict[str, float] = json.loads(capsys.readouterr().out.splitlines()[-1])
    return result


def test_both_protocols_are_measured(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--kitti-frames", "5", "--sunrgbd-frames", "5", "--repeat", "1"]
    result = benchmark_result(words, monkeypatch, capsys)
    assert list(result) == ["kitti_s", "sunrgbd_s"]
    assert all(seconds > 0 for seconds in result.values())


def test_numbers_below_1_are_errors(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match="must be 1 or more"):
        benchmark_result(["--repeat", "0"], monkeypatch, capsys)
