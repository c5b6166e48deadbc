"""Limits on files and folders, so that the code stays easy to find: a file is a concept."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

TESTS = Path(__file__).resolve().parent
ROOT = TESTS.parent
MOST_LINES = 600
MOST_ENTRIES = 25
CODE = ("annotator", "benchmarks", "tests")


def test_files_have_at_most_600_lines() -> None:
    paths = [path for name in CODE for path in (ROOT / name).rglob("*.py")]
    lines = {path.relative_to(ROOT).as_posix(): len(path.read_text("utf-8").splitlines()) for path in paths}
    assert {name: count for name, count in lines.items() if count > MOST_LINES} == {}


def test_folders_with_subfolders_have_at_most_25_entries() -> None:
    """A folder of many files without subfolders is a list, such as that of the commands."""
    large = {}
    for folder in [ROOT / "annotator", *(path for path in (ROOT / "annotator").rglob("*") if path.is_dir())]:
        entries = [path for path in folder.iterdir() if path.suffix == ".py" or any(path.glob("**/*.py"))]
        if len(entries) - 1 > MOST_ENTRIES and any(path.is_dir() for path in entries):
            large[folder.relative_to(ROOT).as_posix()] = len(entries)
    assert large == {}


def test_every_package_has_a_docstring() -> None:
    packages = (ROOT / "annotator").rglob("__init__.py")
    assert [path for path in packages if not path.read_text("utf-8").startswith('"""')] == []


def test_every_test_file_has_a_unique_name() -> None:
    """pytest imports test files by their name alone, so it cannot collect two of the same name."""
    names = Counter(path.name for path in TESTS.rglob("test_*.py"))
    assert [name for name, count in names.items() if count > 1] == []
