"""Limits on the number of packages and modules, so that the code stays easy to navigate."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parent
PACKAGE = TESTS.parent / "annotator"
LARGE_ROOMS = {"cli"}
"""One file per command."""


def modules(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.glob("*.py") if path.stem != "__init__")


def rooms(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and any(path.glob("*.py")))


def test_workflows_has_few_packages_and_modules():
    assert len(rooms(PACKAGE / "workflows")) <= 12
    assert len(modules(PACKAGE / "workflows")) <= 10


@pytest.mark.parametrize("room", sorted({path.parent for path in PACKAGE.rglob("*.py")}), ids=lambda path: path.name)
def test_no_package_has_more_than_25_modules(room: Path):
    if room.name not in LARGE_ROOMS:
        assert len(modules(room)) <= 25, f"{room.name}/ has too many modules: group them in folders"


def test_every_package_has_a_docstring():
    for init in PACKAGE.rglob("__init__.py"):
        assert init.read_text().startswith('"""'), init


def test_every_test_file_has_a_unique_name():
    """pytest imports test files by their name alone, so it cannot collect two of the same name."""
    names = Counter(path.name for path in TESTS.rglob("test_*.py"))
    assert [name for name, count in names.items() if count > 1] == []
