"""The workbench's benchmark, small: the parts that need no browser, and what it refuses."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from annotator.types.errors import ConfigError
from benchmarks import workbench
from benchmarks.workbench_browser import frames_of
from benchmarks.workbench_edits import clients, kill
from benchmarks.workbench_server import LABEL, make_project, percentile, serving


@pytest.mark.parametrize(
    ("values", "percent", "expected"),
    [
        ([3.0], 95, 3.0),
        ([1.0, 2.0, 3.0, 4.0], 50, 2.0),
        (list(map(float, range(1, 101))), 95, 95.0),
        ([2.0, 1.0], 95, 2.0),
    ],
)
def test_percentiles_are_values_that_were_measured(values: list[float], percent: float, expected: float) -> None:
    assert percentile(values, percent) == expected


def test_a_part_that_there_is_not_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["workbench", "--only", "kill,colour"])
    with pytest.raises(ConfigError, match="colour"):
        workbench.main()


def test_every_acknowledged_edit_outlives_kill_9(generated: Path, tmp_path: Path) -> None:
    make_project(tmp_path, "people", (LABEL,), [generated / "people"])
    result = kill(tmp_path, "people", frames_of(tmp_path, "people")[0], 2)
    assert result["kills"] == 2
    assert result["edits_acknowledged"] > 0
    assert result["kills_that_lost_an_edit"] == 0


def test_edits_of_several_clients_on_one_frame_are_all_there(generated: Path, tmp_path: Path) -> None:
    make_project(tmp_path, "people", (LABEL,), [generated / "people"])
    with serving(tmp_path) as server:
        result = clients(None, server, "people", frames_of(tmp_path, "people")[0], 4, 2)
    assert (result["edits"], result["lost"], result["crossed"], result["events_missed"]) == (8, 0, 0, 0)
