"""The figures of the soak benchmark, from what its clients saw."""

from __future__ import annotations

import sys

import pytest

from annotator.types.errors import ConfigError
from benchmarks import soak


def test_growth_is_counted_from_the_end_of_the_warm_up() -> None:
    args = soak.Arguments(minutes=30.0)
    # 300 MB more within the first five minutes, then 1 MB a minute
    memory = [(at, 500.0 + min(at, 300.0) + at / 60) for at in map(float, range(0, 1800, 2))]
    seen = soak.Seen(saves_s=[0.1] * 19 + [0.5], stale=3, refused=["500 "])
    figures = soak._figures(memory, seen, args)
    assert figures["memory_start_mb"] == 500.0
    assert figures["memory_growth"] == pytest.approx(22.0 / 806.5, abs=0.002)
    assert (figures["save_p95_s"], figures["stale"], figures["refused_not_stale"]) == (0.1, 3, 1)
    assert figures["failures"] == ["500 "]


def test_an_unknown_kind_of_job_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["soak", "--jobs", "train,dream"])
    with pytest.raises(ConfigError, match="dream"):
        soak.main()
