"""Projects that are made once, for tests to copy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

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
