"""A new server loads what the first page needs before it is asked for."""

from __future__ import annotations

import logging
import subprocess
import sys

import pytest

from annotator.web.background import preload as module
from annotator.web.background.preload import preload

LOADED = """
import sys
from annotator.web.background.preload import preload
before = {"numba", "viser"} & set(sys.modules)
preload().join()
from annotator.geometry.kernels import points_in_box
print(sorted(before), sorted({"numba", "viser"} & set(sys.modules)), bool(points_in_box.signatures))
"""


def test_what_is_loaded_late_is_loaded_with_its_compiled_functions() -> None:
    run = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True, check=True)
    assert run.stdout.split("\n")[-2] == "[] ['numba', 'viser'] True", run.stdout + run.stderr


def test_a_failure_is_logged_and_does_no_harm(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken() -> None:
        raise OSError("no such library")

    monkeypatch.setattr(module, "warm_frame", broken)
    with caplog.at_level(logging.ERROR, "annotator.web"):
        preload().join()
    assert "no such library" in caplog.text
