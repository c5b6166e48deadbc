"""The benchmark of the workbench, at a small size: the parts without a browser, and errors."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from annotator.types.errors import ConfigError
from benchmarks import workbench
from benchmarks.served import LABEL, frames_of, make_project, percentile, serving
from benchmarks.workbench import clients


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


def test_no_edit_of_several_clients_on_one_frame_is_lost(generated: Path, tmp_path: Path) -> None:
    make_project(tmp_path, "people", (LABEL,), [generated / "people"])
    with serving(tmp_path) as server:
        result = clients(None, server, "people", frames_of(tmp_path, "people")[0], 4, 2)
    assert (result["edits"], result["lost"], result["crossed"], result["events_missed"]) == (8, 0, 0, 0)
