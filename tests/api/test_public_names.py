"""The public names of `annotator`: complete, documented, visible to type checkers, and cheap to import."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import annotator
from annotator import api

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("numpy", "torch", "open3d", "viser", "cv2", "scipy", "numba", "sqlalchemy", "pydantic", "ultralytics")


def test_import_loads_no_heavy_package() -> None:
    script = f"import annotator, json, sys; print(json.dumps([m for m in {HEAVY!r} if m in sys.modules]))"
    answer = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert json.loads(answer.stdout) == []


def test_the_package_exports_the_names_of_the_api() -> None:
    assert set(annotator.__all__) == {*api.__all__, "__version__"}
    for name in api.__all__:
        assert getattr(annotator, name) is getattr(api, name)
    assert set(annotator.__all__) <= set(dir(annotator))


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Boxes'"):
        _ = annotator.Boxes  # type: ignore[attr-defined]


def test_type_checkers_see_the_same_names() -> None:
    tree = ast.parse((ROOT / "annotator/__init__.py").read_text(encoding="utf-8"))
    seen = {x.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for x in node.names}
    assert set(api.__all__) <= seen
    assert (ROOT / "annotator/py.typed").is_file()


def test_the_guide_has_a_row_for_every_name() -> None:
    text = (ROOT / "docs/python.md").read_text(encoding="utf-8")
    rows = {name for row in re.findall(r"^\|(.*?)\|", text, re.MULTILINE) for name in re.findall(r"`(\w+)", row)}
    assert set(api.__all__) <= rows, f"docs/python.md does not mention {sorted(set(api.__all__) - rows)}"


def test_every_public_name_has_a_docstring() -> None:
    for name in api.__all__:
        assert (getattr(api, name).__doc__ or "").strip(), f"{name} has no docstring"
