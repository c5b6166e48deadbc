"""Projects that are made once, for tests to copy; and commands that are run in this process."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from annotator.cli.main import main


@pytest.fixture(scope="session")
def made_rooms(made_once: Callable[[str, Callable[[Path], object]], Path], generated: Path) -> Path:
    """Two folders of projects, `plain` and `labelled`, each with a `room` of generated people; do not change them."""

    def fill(folder: Path) -> None:
        for root, options in (("plain", ["--no-labels"]), ("labelled", [])):
            main(["new", "room", "--classes", "person", "--projects", str(folder / root)])
            main(["add", "room", str(generated / "people"), *options, "--projects", str(folder / root)])

    return made_once("cli_rooms", fill)


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of projects, set by the environment variable; commands run in its parent."""
    folder = tmp_path / "my projects"
    monkeypatch.setenv("ANNOTATOR_PROJECTS", str(folder))
    monkeypatch.chdir(tmp_path)
    return folder


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """`run("stats room")`, `run("add", "room", path, code=2)`: what a command prints; of a refused one, its error."""

    def run(*words: object, code: int = 0) -> str:
        capsys.readouterr()
        assert main(str(words[0]).split() if len(words) == 1 else [*map(str, words)]) == code
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        return captured.err if code == 2 else captured.out

    return run


@pytest.fixture
def stats(run: Callable[..., str]) -> Callable[[str], dict[str, Any]]:
    """`stats("room")`: what `annotator stats` counts."""

    def stats(project: str) -> dict[str, Any]:
        (line,) = run("stats", project, "--json").splitlines()
        found: dict[str, Any] = json.loads(line)
        return found

    return stats
