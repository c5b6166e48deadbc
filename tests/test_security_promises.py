"""SECURITY.md names the tests that keep its promises."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


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
