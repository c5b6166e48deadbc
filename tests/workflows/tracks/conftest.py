"""True boxes of the generated people."""

from __future__ import annotations

from pathlib import Path

import pytest

from annotator.recordings import open_recording
from annotator.types import Truth
from annotator.workflows.recorded.reading import load_truth


@pytest.fixture(scope="module")
def truths(generated: Path) -> list[list[Truth]]:
    """Three people in each of five frames, in one order."""
    recording = open_recording(generated / "people")
    return [list(load_truth(recording, index, recording.frame(index))) for index in range(5)]
