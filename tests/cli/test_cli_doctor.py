"""`annotator doctor`"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from annotator import __version__
from annotator.cli.main import main
from annotator.workflows import doctor
from annotator.workflows.doctor import Line, Report, State

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(("state", "code"), [(State.OK, 0), (State.WARNING, 0), (State.FAILED, 1)])
def test_the_exit_code_is_1_if_a_check_failed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, state: State, code: int
) -> None:
    asked: list[Path] = []

    def examine(projects: Path) -> Report:
        asked.append(projects)
        line = Line(section="machine", name="thing", state=state, found="there")
        return Report(annotator_version="1", lines=(line,))

    monkeypatch.setattr(doctor, "examine", examine)
    assert main(["doctor", "--projects", str(tmp_path)]) == code
    assert f"thing  there: {state}\n" in capsys.readouterr().out
    assert main(["doctor", "--json", "--projects", str(tmp_path)]) == code
    assert Report.model_validate_json(capsys.readouterr().out).lines[0].state is state
    assert asked == [tmp_path, tmp_path]


@pytest.mark.slow
def test_the_report_contains_no_home_path_and_leaves_no_files(tmp_path: Path) -> None:
    """Run in a temporary home: no path in it is printed, and the only new files are ultralytics' settings."""
    home, temporary, here = tmp_path / "home", tmp_path / "temporary", tmp_path / "home" / "data"
    here.mkdir(parents=True)
    temporary.mkdir()
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("XDG_", "ANNOTATOR_"))}
    environment |= {"HOME": str(home), "TMPDIR": str(temporary), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-m", "annotator", "doctor", "--json"],
        cwd=here,
        env=environment,
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    report = Report.model_validate_json(done.stdout)
    assert done.returncode == int(report.failed), done.stderr
    failed = [line for line in report.lines if line.state is State.FAILED]
    assert failed == [], "this machine has what the tests need"
    assert report.annotator_version == __version__
    assert str(home) not in done.stdout
    assert "for ~/data/projects" in done.stdout
    sections = list(dict.fromkeys(line.section for line in report.lines))
    assert sections == ["machine", "packages", "extras", "backends", "detectors", "self-test"]
    assert list(temporary.iterdir()) == []
    assert {path.name for path in home.rglob("*") if path.is_file()} <= {"settings.json"}
