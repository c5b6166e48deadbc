"""The command line as a whole: quick help, lazy commands, and one exit point for errors."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from annotator import __version__
from annotator.cli import main as cli
from annotator.cli.main import main
from annotator.cli.table import COMMANDS, Command
from annotator.types.errors import FormatError

HEAVY = ("torch", "torchvision", "ultralytics", "open3d", "viser", "av", "ray")
LIGHTER = ("numpy", "scipy", "cv2", "pydantic", "sqlalchemy", "tyro", "rich")


def python(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)


def test_help_loads_no_library_and_answers_at_once() -> None:
    code = "import sys; from annotator.cli.main import main; main(['--help']); print(*sys.modules, file=sys.stderr)"
    result = python(code)
    assert result.returncode == 0
    assert "usage: annotator" in result.stdout
    assert not set(HEAVY + LIGHTER) & set(result.stderr.split())

    def seconds() -> float:
        begin = time.perf_counter()
        subprocess.run([sys.executable, "-m", "annotator.cli.main", "--help"], check=True, capture_output=True)
        return time.perf_counter() - begin

    # the best of some: other tests may keep the machine busy
    assert min(seconds() for _ in range(5)) < 0.5


def test_every_command_exists_and_its_help_loads_nothing_heavy() -> None:
    """One process explains all commands; the libraries that take seconds are left to the work itself."""
    code = """
import contextlib, io, sys
from annotator.cli.main import main
from annotator.cli.table import COMMANDS
for name in COMMANDS:
    text = io.StringIO()
    try:
        with contextlib.redirect_stdout(text):
            main([name, "--help", "--debug"])
    except SystemExit as end:
        assert end.code == 0, (name, end.code)
    assert f"usage: annotator {name}" in text.getvalue(), (name, text.getvalue())
print(*sys.modules)
"""
    result = python(code)
    assert result.returncode == 0, result.stderr
    loaded = sorted(set(HEAVY) & set(result.stdout.split()))
    assert loaded == [], "import these inside the functions that use them"


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["-h"]) == 0
    said = capsys.readouterr().out
    for name, command in COMMANDS.items():
        assert name in said
        assert command.summary in said


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"annotator {__version__}\n"


def test_nothing_asked_shows_the_help_and_fails(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "usage: annotator" in capsys.readouterr().out


def test_unknown_command_is_answered_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspct"]) == 2
    assert capsys.readouterr().err == "error: 'inspct' is no command of annotator; did you mean 'inspect'?\n"
    assert main(["xyzzy"]) == 2
    assert "there are new, add" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["new"], ["inspect", "a", "b"], ["new", "x", "--classes", "a", "--rotation", "up"]])
def test_a_command_line_that_does_not_fit(words: list[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2


def fake(monkeypatch: pytest.MonkeyPatch, run: Callable[..., int | None]) -> None:
    """Puts a command `fake` into the table."""
    monkeypatch.setattr(cli, "_fake", run, raising=False)
    monkeypatch.setitem(COMMANDS, "fake", Command("annotator.cli.main:_fake", "for this test"))


def test_the_exit_code_is_the_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(*, code: int = 0) -> int:
        """Ends with the code."""
        return code

    fake(monkeypatch, run)
    assert main(["fake"]) == 0
    assert main(["fake", "--code", "1"]) == 1


def test_errors_end_in_one_message(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    long = "word " * 60

    def run() -> None:
        """Fails as a user's file may fail."""
        raise FormatError(Path("a/[b].json"), long.strip(), 3)

    fake(monkeypatch, run)
    assert main(["fake"]) == 2
    captured = capsys.readouterr()
    # neither wrapped nor read as markup
    assert captured.err == f"error: a/[b].json:3: {long.strip()}\n"
    assert captured.out == ""
    for words in (["--debug", "fake"], ["fake", "--debug"]):
        with pytest.raises(FormatError):
            main(words)


def test_a_fault_of_ours_says_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def run() -> None:
        """Fails as a program may fail."""
        raise ZeroDivisionError("by zero")

    fake(monkeypatch, run)
    assert main(["fake"]) == 1
    said = capsys.readouterr().err
    assert "ZeroDivisionError: by zero" in said
    assert "--debug" in said
    assert "Traceback" not in said
    with pytest.raises(ZeroDivisionError):
        main(["fake", "--debug"])


def test_interrupted(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def run() -> None:
        """Is stopped with Ctrl-C."""
        raise KeyboardInterrupt

    fake(monkeypatch, run)
    assert main(["fake"]) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_debug_after_two_dashes_is_an_argument(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "_dispatch", lambda words: sys.stdout.write(json.dumps(words)) and 0)
    assert main(["a", "--debug", "--", "--debug"]) == 0
    assert json.loads(capsys.readouterr().out) == ["a", "--", "--debug"]


@pytest.mark.skipif(os.name != "posix", reason="pipes break otherwise elsewhere")
def test_a_reader_that_goes_away_is_no_error() -> None:
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
