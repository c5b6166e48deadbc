"""The progress bar remains after completed work, and is removed after an error."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from annotator.cli import output
from annotator.cli.main import main
from annotator.cli.output import counted


@pytest.mark.parametrize("terminal", [True, False])
def test_the_bar_is_removed_only_after_an_error(monkeypatch: pytest.MonkeyPatch, terminal: bool) -> None:
    shown = io.StringIO()
    monkeypatch.setattr(output, "Console", lambda stderr: Console(file=shown, force_terminal=terminal, width=100))
    with counted("drawing") as tell:
        tell(3, 4)
    assert "3/4" in _left(shown.getvalue())
    shown.truncate(0)
    with pytest.raises(ValueError, match="no"), counted("drawing"):
        raise ValueError("no")
    assert "drawing" not in _left(shown.getvalue())


def test_an_error_is_printed_without_a_bar(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["generate", "somewhere", "--frames", "0"]) == 2
    assert capsys.readouterr().err.startswith("error: ")


def _left(written: str) -> str:
    """The final content of a terminal, without the lines that were erased."""
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
