"""Invalid arguments of commands and benchmarks give a one-line error, not a traceback."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from annotator.cli.main import main

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty project `p`."""
    monkeypatch.setenv("ANNOTATOR_PROJECTS", str(tmp_path / "projects"))
    monkeypatch.chdir(tmp_path)
    assert main(["new", "p", "--classes", "x"]) == 0
    return tmp_path / "projects" / "p"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["train", "p", "--epochs", "-3"], "epochs: Input should be greater than or equal to 1, not -3"),
        (["train", "p", "--size", "100"], "image_size_px: Input should be a multiple of 32, not 100"),
        (["demo", "d", "--frames", "1"], "--frames must be 2 or more, not 1"),
    ],
)
def test_invalid_arguments_are_errors_and_change_nothing(
    project: Path, capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    before = sorted(project.parent.parent.iterdir())
    assert main(words) == 2
    assert says in capsys.readouterr().err
    assert sorted(project.parent.parent.iterdir()) == before


def test_extras_named_in_errors_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    code = "\n".join(path.read_text() for path in (ROOT / "annotator").rglob("*.py"))
    named = re.findall(r'MissingExtraError\("[^"]+", "(\w+)"\)|rcv-annotator\[(\w+)\]', code)
    assert len(named) >= 5
    assert {name for pair in named for name in pair if name} <= set(extras)
