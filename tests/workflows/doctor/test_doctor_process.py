"""Exceptions, crashes and hangs in a check become lines of the report."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from annotator.workflows.doctor import Line, State, examine
from annotator.workflows.doctor.examine import run_check


def fine(projects: Path) -> Iterator[Line]:
    # libraries may print to standard output
    os.write(1, b"noise")
    yield Line(section="test", name="fine", state=State.OK, found=projects.name)


def raises(projects: Path) -> Iterator[Line]:
    yield from fine(projects)
    raise LookupError("a broken library\nand more")


def crashes(_: Path) -> Iterator[Line]:
    os.abort()
    yield


def leaves(_: Path) -> Iterator[Line]:
    sys.exit(3)
    yield


def hangs(_: Path) -> Iterator[Line]:
    time.sleep(3600)
    yield


def test_a_check_that_raises_keeps_its_earlier_lines(tmp_path: Path) -> None:
    found, lost = run_check("raises", raises, tmp_path)
    assert (found.name, found.state) == ("fine", State.OK)
    assert (lost.name, lost.state, lost.found) == ("raises", State.FAILED, "LookupError: a broken library")
    assert lost.remedy


def test_a_crash_affects_only_one_check(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    report = examine(tmp_path / "here", {"a": fine, "crashes": crashes, "b": fine, "leaves": leaves, "c": fine})
    assert [(each.name, each.state.value) for each in report.lines] == [
        ("fine", "ok"),
        ("crashes", "failed"),
        ("fine", "ok"),
        ("leaves", "failed"),
        ("fine", "ok"),
    ]
    assert "SIGABRT" in report.lines[1].found
    assert "exit code 3" in report.lines[3].found
    assert report.lines[0].found == "here"
    assert report.failed
    assert "noise" not in capfd.readouterr().out


def test_a_check_that_hangs_is_ended(tmp_path: Path) -> None:
    (lost,) = examine(tmp_path, {"hangs": hangs}, limit_s=1.0).lines
    assert (lost.name, lost.state, lost.found) == ("hangs", State.FAILED, "did not finish within 1 s")
