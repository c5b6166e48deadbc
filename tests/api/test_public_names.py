"""The public names of `annotator`: complete, documented, visible to type checkers, and cheap to import."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
from importlib.util import find_spec
from inspect import signature
from pathlib import Path

import numpy as np
import pytest

import annotator
from annotator import api
from annotator.api.project import Given
from annotator.api.proposing import Options
from annotator.image_bytes import decode_image

ROOT = Path(__file__).resolve().parents[2]
NAMES = set(annotator.__all__) - {"__version__"}
HEAVY = ("numpy", "torch", "open3d", "viser", "cv2", "scipy", "numba", "sqlalchemy", "pydantic", "ultralytics")


def test_import_loads_no_heavy_package() -> None:
    script = f"import annotator, json, sys; print(json.dumps([m for m in {HEAVY!r} if m in sys.modules]))"
    answer = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert json.loads(answer.stdout) == []


def test_the_package_exports_the_names_of_the_api() -> None:
    for name in NAMES:
        assert getattr(annotator, name) is getattr(api, name)
    assert set(annotator.__all__) <= set(dir(annotator))


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Boxes'"):
        _ = annotator.Boxes  # type: ignore[attr-defined]


def test_type_checkers_see_the_same_names() -> None:
    tree = ast.parse((ROOT / "annotator/api/__init__.py").read_text(encoding="utf-8"))
    exported = {x.asname for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for x in node.names}
    assert exported == NAMES
    assert (ROOT / "annotator/py.typed").is_file()


def test_type_checkers_see_the_options_of_functions_for_one_frame_or_several() -> None:
    for function, options in ((annotator.propose, Options), (annotator.Project.detect, Given)):
        taken = {each.name for each in signature(function).parameters.values() if each.kind is each.KEYWORD_ONLY}
        assert set(options.__annotations__) == taken


def test_the_guide_has_a_row_for_every_name() -> None:
    text = (ROOT / "docs/python.md").read_text(encoding="utf-8")
    rows = {name for row in re.findall(r"^\|(.*?)\|", text, re.MULTILINE) for name in re.findall(r"`(\w+)", row)}
    assert rows >= NAMES, f"docs/python.md does not mention {sorted(NAMES - rows)}"


EXAMPLES = sorted((ROOT / "docs/examples").glob("*.py"))
MAX_LINES = 40
# What each example must print.
EXPECTED_OUTPUT = {
    "01": r"(hand: centre .* m, size .* m, \d\.\d\d\n){2}",
    "02": r"(frame \d+: 2 2D boxes, 2 3D boxes\n){2}",
    "03": r"step 1: 2 views, .*continues\nstep 2: 24 views",
    "04": r"3 frames done, 0 were done before, 0 failed\n(.*\n)+0 frames done, 3 were done before, 0 failed\n",
    "05": r"rcv +2 +6 +1\.0000\nkitti +2 +6 (.*\n)+openlabel +2 +6 +1\.0000\n(.*\n)+boxes\.json: room/000000",
    "06": r"exact views\n.*\n +hand +6 +6 +1\.00(.*\n)+nearest cluster",
    "07": r"frame \d+: 2 boxes in \d+ ms, 2 warm starts\n",
    "08": r"8 frames, 16 boxes, 0 failed(.*\n)+000007 +.* cm  .* cm\n",
}


def test_all_examples_are_short_and_in_the_guide() -> None:
    assert [path.name[:2] for path in EXAMPLES] == sorted(EXPECTED_OUTPUT)
    text = (ROOT / "docs/python.md").read_text(encoding="utf-8")
    for path in EXAMPLES:
        assert len(path.read_text(encoding="utf-8").splitlines()) < MAX_LINES, path.name
        assert f"examples/{path.name}" in text, f"docs/python.md does not mention {path.name}"


# Runs scripts one after the other in one process, so that torch is loaded once.
RUN = """
import contextlib, pathlib, os, runpy, sys, traceback
scripts = list(zip(sys.argv[1::2], sys.argv[2::2]))
for script, folder in scripts:
    os.chdir(folder)
    sys.argv = [script]
    with open("printed.txt", "w", encoding="utf-8") as printed, contextlib.redirect_stdout(printed):
        try:
            runpy.run_path(script, run_name="__main__")
        except BaseException:
            pathlib.Path("error.txt").write_text(traceback.format_exc(), encoding="utf-8")
"""


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Path]:
    """The folder in which each example has run."""
    if find_spec("ray") is None:
        pytest.skip("ray is not installed; run scripts/setup test")
    made = {path: tmp_path_factory.mktemp(path.stem) for path in EXAMPLES}
    arguments = [part for pair in made.items() for part in pair]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    ran = subprocess.run([sys.executable, "-c", RUN, *arguments], env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    return made


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_runs(path: Path, folders: dict[Path, Path]) -> None:
    error, printed = folders[path] / "error.txt", (folders[path] / "printed.txt").read_text(encoding="utf-8")
    assert not error.exists(), error.read_text(encoding="utf-8")
    assert re.search(EXPECTED_OUTPUT[path.name[:2]], printed), printed
    written = sorted(folders[path].glob("*.png"))
    assert [picture.name for picture in written] == re.findall(r"Writes (\S+\.png)", path.read_text(encoding="utf-8"))
    for picture in written:
        # green edges of a box, or the red ones on pseudo-views
        blue, green, red = np.moveaxis(decode_image(picture.read_bytes(), 1).astype(int), -1, 0)
        edges = ((green > red + 100) & (green > blue + 60)) | ((red > green + 120) & (red > blue + 120))
        assert edges.sum() > 100, picture.name
