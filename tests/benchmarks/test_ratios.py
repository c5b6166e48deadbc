"""The benchmark of ratios: a ratio above its bound is reported with exit code 1. The times here are simulated."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator

import pytest

from benchmarks import ratios
from benchmarks.ratios import Arguments, Outcome, Ratio, measured, run


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[float], Callable[[], None]]]:
    """Simulated work of given durations, on a simulated clock."""
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])

    def takes(*seconds: float) -> Callable[[], None]:
        left = list(seconds)

        def work() -> None:
            now[0] += left.pop(0) if len(left) > 1 else left[0]

        return work

    yield takes


def test_a_ratio_compares_medians(clock: Callable[..., Callable[[], None]]) -> None:
    # the first run of each does not count, and the median ignores one slow run
    work, reference = clock(99.0, 3.0, 3.0, 30.0, 3.0), clock(99.0, 2.0)
    assert measured(Ratio("a / b", work, reference, most=2.0, repeats=3), 1) == Outcome("a / b", 1.5, 2.0)


def test_the_best_round_counts_and_a_good_round_ends_the_measurement(
    clock: Callable[..., Callable[[], None]],
) -> None:
    slow_first = clock(1.0, *[6.0] * 3, 1.0, *[3.0] * 3, 1.0, *[1.0] * 3)
    outcome = measured(Ratio("a / b", slow_first, clock(2.0), most=2.0, repeats=3), 5)
    assert outcome.ratio == 1.5
    assert not outcome.is_worse
    never = measured(Ratio("a / b", clock(6.0), clock(2.0), most=2.0, repeats=3), 5)
    assert never.ratio == 3.0
    assert never.is_worse


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
