"""The report's text and JSON."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from annotator.workflows.doctor import Line, Report, State, as_text
from annotator.workflows.doctor.report import shortened, without_home


def line(state: State, remedy: str = "", **figures: float) -> Line:
    return Line(section="machine", name=str(state), state=state, found="something", remedy=remedy, figures=figures)


def test_each_line_has_its_state_and_remedy() -> None:
    lines = (line(State.OK), line(State.WARNING, "mend it"), line(State.FAILED, "replace it"))
    text = list(as_text(Report(annotator_version="1.2.3", lines=lines)))
    assert text[0] == "annotator 1.2.3"
    assert [row.rsplit(": ", 1)[1] for row in text if "something" in row] == ["ok", "warning", "failed"]
    assert [row.split("-> ")[1] for row in text if "-> " in row] == ["mend it", "replace it"]
    assert text[-1] == "1 ok, 1 warning, 1 failed"


@pytest.mark.parametrize(("state", "failed"), [(State.OK, False), (State.WARNING, False), (State.FAILED, True)])
def test_only_failed_lines_make_the_report_fail(state: State, failed: bool) -> None:
    assert Report(annotator_version="1", lines=(line(State.OK), line(state))).failed == failed


def test_the_json_reads_back_also_with_nan_and_infinity() -> None:
    report = Report(annotator_version="1", lines=(line(State.FAILED, value=math.nan, bound=math.inf),))
    text = report.model_dump_json()
    assert "null" not in text
    back = Report.model_validate_json(text)
    assert math.isnan(back.lines[0].figures["value"]) and back.lines[0].figures["bound"] == math.inf


def test_the_json_schema_is_unchanged() -> None:
    """Programs read it; raise `REPORT_VERSION` with every change."""
    report = json.loads(Report(annotator_version="1", lines=(line(State.OK, cores=2),)).model_dump_json())
    assert report == {
        "report_version": 1,
        "annotator_version": "1",
        "lines": [
            {
                "section": "machine",
                "name": "ok",
                "state": "ok",
                "found": "something",
                "remedy": "",
                "figures": {"cores": 2.0},
            }
        ],
    }


def test_the_home_folder_is_not_shown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    home, link = tmp_path / "ada", tmp_path / "link"
    home.mkdir()
    link.symlink_to(home)
    monkeypatch.setenv("HOME", str(link))
    shown = without_home(
        Line(section="s", name="n", state=State.OK, found=f"in {home}/a and {link}/b", remedy=f"see {home}/c")
    )
    assert (shown.found, shown.remedy) == ("in ~/a and ~/b", "see ~/c")
    assert shortened(str(home)) == "~"
    assert shortened(f"{home}line/a") == f"{home}line/a"
    monkeypatch.setenv("HOME", "/")
    assert shortened("/usr/lib") == "/usr/lib"
