"""The command line as a whole: fast help, lazy imports, and errors."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from annotator.cli import main as cli
from annotator.cli.main import COMMANDS, Command, main
from annotator.cli.output import counted
from annotator.types.errors import FormatError
from annotator.workflows import doctor
from annotator.workflows.doctor import Line, Report, State

HEAVY = ("torch", "torchvision", "ultralytics", "open3d", "viser", "av", "ray")
LIGHTER = ("numpy", "scipy", "cv2", "pydantic", "sqlalchemy", "tyro", "rich")


def python(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)


def test_help_loads_no_library() -> None:
    code = "import sys; from annotator.cli.main import main; main(['--help']); print(*sys.modules, file=sys.stderr)"
    result = python(code)
    assert result.returncode == 0
    assert "usage: annotator" in result.stdout
    assert not set(HEAVY + LIGHTER) & set(result.stderr.split())


def test_every_command_exists_and_its_help_loads_nothing_heavy() -> None:
    """One process prints the help of all commands; it must not import the slow libraries."""
    code = """
import contextlib, io, sys
from annotator.cli.main import main
from annotator.cli.main import COMMANDS
for name in COMMANDS:
    text = io.StringIO()
    try:
        with contextlib.redirect_stdout(text):
            main([*name.split(), "--help", "--debug"])
    except SystemExit as end:
        assert end.code == 0, (name, end.code)
    assert f"usage: annotator {name}" in text.getvalue(), (name, text.getvalue())
print(*sys.modules)
"""
    result = python(code)
    assert result.returncode == 0, result.stderr
    loaded = sorted(set(HEAVY) & set(result.stdout.split()))
    assert loaded == [], "import these inside the functions that use them"


def test_an_option_that_is_given_twice_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--folder", "a", "--folder=b"]) == 2
    assert "--folder is given twice; give it once, with all its values: --folder A B" in capsys.readouterr().err


def test_completion_offers_all_commands_and_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "bash"]) == 0
    written = capsys.readouterr().out
    assert all(f"{name.split()[-1]}" in written for name in COMMANDS)
    (tmp_path / "bash").write_text(written)
    code = (
        'source "$0"; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=(); '
        '_tyro_annotator; echo "${COMPREPLY[@]}"; complete -p annotator'
    )

    def completed(*words: str) -> tuple[str, str]:
        result = subprocess.run(
            ["bash", "-c", code, tmp_path / "bash", *words], capture_output=True, text=True, check=True
        ).stdout.splitlines()
        return result[0], result[1]

    assert completed("annotator", "ex")[0] == "export"
    assert completed("annotator", "project", "move", "hands", "--p")[0] == "--projects"
    assert completed("annotator", "export", "hands", "out", "--format", "kitti-")[0] == "kitti-tracking"
    assert completed("annotator", "help", "ex")[0] == "export"
    # elsewhere bash offers files
    assert "-o default" in completed("annotator", "inspect", "x")[1]


ENDINGS = [
    (None, 0, ""),
    (1, 1, ""),
    # not wrapped, and not interpreted as markup
    (FormatError(Path("a/[b].json"), ("word " * 60).strip(), 3), 2, f"error: a/[b].json:3: {('word ' * 60).strip()}\n"),
    (ZeroDivisionError("by zero"), 1, "error: ZeroDivisionError: by zero\nthis is a bug in annotator; --debug shows"),
    (KeyboardInterrupt(), 130, "interrupted\n"),
]


@pytest.mark.parametrize(("end", "code", "says"), ENDINGS)
def test_how_a_command_ends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], end: Any, code: int, says: str
) -> None:
    def run() -> int | None:
        """Ends."""
        if isinstance(end, Exception):
            with counted("a bar that the message must not stand after"):
                raise end
        if end is not None and not isinstance(end, int):
            raise end
        return end  # type: ignore[no-any-return]

    monkeypatch.setattr(cli, "_fake", run, raising=False)
    monkeypatch.setitem(COMMANDS, "fake", Command("main:_fake", "for this test"))
    assert main(["fake"]) == code
    captured = capsys.readouterr()
    assert captured.err.startswith(says) and "Traceback" not in captured.err and captured.out == ""
    if isinstance(end, BaseException):
        for words in (["--debug", "fake"], ["fake", "--debug"]):
            with pytest.raises(type(end)):
                main(words)


@pytest.mark.skipif(os.name != "posix", reason="other systems handle closed pipes differently")
def test_a_closed_pipe_is_not_an_error() -> None:
    code = """
import sys
from annotator.cli import main as cli
def endless(words):
    while True:
        sys.stdout.write("line\\n")
cli._dispatch = endless
sys.exit(cli.main(["x"]))
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stderr is not None
    assert process.stdout.readline() == b"line\n"
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait(30) == 128 + 13
    process.stderr.close()


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
