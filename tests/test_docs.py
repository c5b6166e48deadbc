"""The documentation: its pictures are shown and small, its links lead somewhere, its tables follow from files."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = (ROOT / "README.md", *sorted(DOCS.glob("**/*.md")))
SUFFIXES = (".jpg", ".png", ".svg", ".webp")
SHOWN = re.compile(r"!\[[^\]]+\]\(([^)]+)\)")
MOST_BYTES = {".jpg": 260_000, ".svg": 260_000, ".webp": 1_500_000}


@pytest.fixture
def cold_start(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(DOCS / "pictures")
    return importlib.import_module("cold_start")


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


def row(label: str, taught: int, iou: float, objects: int = 9) -> dict[str, object]:
    return {"label": label, "taught": taught, "objects": objects, "mean_iou": iou, "recall_50": iou / 2}


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Results of two recordings, with a class of a single object."""
    first = [row("van", 0, 0.6), row("van", 5, 0.7), row("van (clusters)", 0, 0.5), row("lamp", 0, 0.25, objects=1)]
    for name, rows in (("drive", first), ("hands", [row("hand", 0, 0.4), row("hand", 20, 0.8)])):
        (tmp_path / f"{name}.json").write_text(json.dumps({"results": rows}))
    return tmp_path


def test_tables_have_a_row_for_each_class(cold_start: ModuleType, results: Path) -> None:
    assert cold_start.taught_table(cold_start.read_results(results))[2:] == [
        "| drive | van | 9 | 0.50 (0.25) | 0.60 (0.30) | – | 0.70 (0.35) | – |",
        "| drive | lamp | 1 | – | 0.25 (0.12) | – | – | – |",
        "| hands | hand | 9 | – | 0.40 (0.20) | – | – | 0.80 (0.40) |",
    ]


def test_only_the_lines_between_the_markers_are_replaced(cold_start: ModuleType, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- results: begin -->\nold\n<!-- results: end -->\nb\n")
    for _ in range(2):
        cold_start.replace_table(page, ["new"])
        assert page.read_text() == "a\n<!-- results: begin -->\nnew\n<!-- results: end -->\nb\n"
    page.write_text("a\n<!-- results: begin -->\nold\nb\n")
    with pytest.raises(ValueError, match=r"page\.md has no line .*results: end"):
        cold_start.replace_table(page, ["new"])
    assert "old" in page.read_text()
