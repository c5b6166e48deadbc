"""Each example runs as a reader would run it, prints its table, and leaves the picture that it promises."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from annotator.image_bytes import decode_image

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "docs/examples").glob("*.py"))
MOST_LINES = 40
# What each prints when it has done what it is about.
SAYS = {
    "01": r"(hand: centre .* m, size .* m, \d\.\d\d\n){2}",
    "02": r"(frame \d+: 2 2D boxes, 2 3D boxes\n){2}",
    "03": r"step 1: 2 views, .*continues\nstep 2: 24 views",
    "04": r"3 frames done, 0 were done before, 0 failed\n(.*\n)+0 frames done, 3 were done before, 0 failed\n",
    "05": r"rcv +2 +6 +1\.0000\nkitti +2 +6 (.*\n)+openlabel +2 +6 +1\.0000\n(.*\n)+boxes\.json: room/000000",
    "06": r"exact views\n.*\n +hand +6 +6 +1\.00(.*\n)+nearest cluster",
    "07": r"frame \d+: 2 boxes in \d+ ms, 2 warm starts\n",
    "08": r"8 frames, 16 boxes, 0 failed(.*\n)+000007 +.* cm  .* cm\n",
}


def test_there_are_eight_from_simple_to_rich() -> None:
    assert [path.name[:2] for path in EXAMPLES] == sorted(SAYS)
    text = (ROOT / "docs/python.md").read_text(encoding="utf-8")
    for path in EXAMPLES:
        assert len(path.read_text(encoding="utf-8").splitlines()) < MOST_LINES, path.name
        assert f"examples/{path.name}" in text, f"docs/python.md does not mention {path.name}"


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_runs(path: Path, tmp_path: Path) -> None:
    if path.name.startswith("08"):
        pytest.importorskip("ray")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    ran = subprocess.run([sys.executable, path], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert re.search(SAYS[path.name[:2]], ran.stdout), ran.stdout
    written = sorted(tmp_path.glob("*.png"))
    assert [picture.name for picture in written] == re.findall(r"Writes (\S+\.png)", path.read_text(encoding="utf-8"))
    for picture in written:
        # green edges of a box, or the red ones on pseudo-views
        blue, green, red = np.moveaxis(decode_image(picture.read_bytes(), 1).astype(int), -1, 0)
        edges = ((green > red + 100) & (green > blue + 60)) | ((red > green + 120) & (red > blue + 120))
        assert edges.sum() > 100, picture.name
