"""The progress bar stays where the work was done, and goes where an error ended it."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from annotator.cli import progress
from annotator.cli.main import main
from annotator.cli.progress import counted


@pytest.mark.parametrize("terminal", [True, False])
def test_a_bar_goes_with_an_error_and_stays_without(monkeypatch: pytest.MonkeyPatch, terminal: bool) -> None:
    shown = io.StringIO()
    monkeypatch.setattr(progress, "Console", lambda stderr: Console(file=shown, force_terminal=terminal, width=100))
    with counted("drawing") as tell:
        tell(3, 4)
    assert "3/4" in _left(shown.getvalue())
    shown.truncate(0)
    with pytest.raises(ValueError, match="no"), counted("drawing"):
        raise ValueError("no")
    assert "drawing" not in _left(shown.getvalue())


def test_an_error_stands_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["generate", "somewhere", "--frames", "0"]) == 2
    assert capsys.readouterr().err.startswith("error: ")


def _left(written: str) -> str:
    """What a terminal shows in the end: a line that is erased after it was written is gone."""
    lines = [""]
    for piece in written.split("\x1b["):
        if piece.startswith("2K"):
            lines[-1] = ""
        if piece.startswith("1A"):
            lines.pop()
        text = piece.split("m", 1)[-1] if "m" in piece[:8] else piece
        head, *more = text.split("\n")
        lines[-1] += head
        lines += more
    return "\n".join(lines)
