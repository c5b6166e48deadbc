"""The benchmark of the workbench: its percentiles and errors."""

from __future__ import annotations

import sys

import pytest

from annotator.types.errors import ConfigError
from benchmarks import workbench
from benchmarks.served import percentile


@pytest.mark.parametrize(
    ("values", "percent", "expected"),
    [
        ([3.0], 95, 3.0),
        ([1.0, 2.0, 3.0, 4.0], 50, 2.0),
        (list(map(float, range(1, 101))), 95, 95.0),
        ([2.0, 1.0], 95, 2.0),
    ],
)
def test_percentiles_by_the_nearest_rank_method(values: list[float], percent: float, expected: float) -> None:
    assert percentile(values, percent) == expected


def test_an_unknown_part_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["workbench", "--only", "switch,colour"])
    with pytest.raises(ConfigError, match="colour"):
        workbench.main()
