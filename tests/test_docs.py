"""The documentation keeps its promises, and files and folders stay small: a file is a concept."""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = (ROOT / "README.md", *sorted(DOCS.glob("**/*.md")))
SUFFIXES = (".jpg", ".png", ".svg", ".webp")
SHOWN = re.compile(r"!\[[^\]]+\]\(([^)]+)\)")
MOST_BYTES = {".jpg": 260_000, ".svg": 260_000, ".webp": 1_500_000}


def test_every_picture_is_shown_and_exists_and_is_small() -> None:
    shown = {
        (page.parent / name).resolve() for page in PAGES for name in SHOWN.findall(page.read_text(encoding="utf-8"))
    }
    stored = {path for path in DOCS.glob("**/*") if path.suffix in SUFFIXES}
    assert shown == stored
    large = [path.name for path in stored if path.stat().st_size > MOST_BYTES[path.suffix]]
    assert not large


def headings(page: Path) -> set[str]:
    """The anchors of a page: its headings in GitHub's form, and those that it names."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    found = [line.lstrip("#").strip() for line in text.splitlines() if line.startswith("#")]
    named = re.findall(r'<a (?:id|name)="([^"]+)"', text)
    return {re.sub(r"[^\w\- ]", "", name.lower()).replace(" ", "-") for name in found} | set(named)


def test_links_between_pages_lead_to_what_exists() -> None:
    dead = []
    for page in (*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", ROOT / "CHANGELOG.md"):
        for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            name, _, anchor = link.partition("#")
            target = page.parent / name if name else page
            if "://" in link or target.suffix in SUFFIXES:
                continue
            if not target.exists() or (anchor and anchor not in headings(target)):
                dead.append(f"{page.name}: {link}")
    assert dead == []


def test_the_pages_stay_short() -> None:
    assert sum(page.stat().st_size for page in DOCS.glob("**/*.md")) <= 160_000
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert len(changes.splitlines()) < 120 and len(changes.encode()) <= 10_000


def test_every_test_that_is_named_exists() -> None:
    text = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    paths = set(re.findall(r"`((?:tests|scripts|benchmarks)/[\w./]+)", text))
    assert paths, "promises are kept by tests"
    assert [path for path in sorted(paths) if not (ROOT / path).exists()] == []
    files = {path.name: path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")}
    assert set(re.findall(r"\btest_\w+\.py", text)) <= files.keys()
    known = set(re.findall(r"^def (test_\w+)", "\n".join(files.values()), re.MULTILINE))
    assert set(re.findall(r"(?<=::)test_\w+|(?<=`)test_\w+(?=`)", text)) <= known


def test_every_promise_names_a_test() -> None:
    text = (ROOT / "SECURITY.md").read_text(encoding="utf-8").partition("## Limits")[0]
    rows = [line for line in text.splitlines() if line.startswith("| ") and not line.startswith("| promised")]
    assert len(rows) > 20
    assert [row for row in rows if not re.search(r"\| `[^|]*(test|fuzz)[^|]* \|$", row)] == []


def test_extras_named_in_errors_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    code = "\n".join(path.read_text() for path in (ROOT / "annotator").rglob("*.py"))
    named = re.findall(r'MissingExtraError\("[^"]+", "(\w+)"\)|rcv-annotator\[(\w+)\]', code)
    assert len(named) >= 5
    assert {name for pair in named for name in pair if name} <= set(extras)


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
    names = Counter(path.name for path in (ROOT / "tests").rglob("test_*.py"))
    assert [name for name, count in names.items() if count > 1] == []
