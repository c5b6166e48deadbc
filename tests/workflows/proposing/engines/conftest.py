"""Projects on generated frames, and the expected result, which every engine must reproduce bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from engine_samples import CONFIG, stored

from annotator.project import Project, create_project
from annotator.recordings import open_recording
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import Detectors
from annotator.workflows.proposing.annotate import annotate_with
from annotator.workflows.proposing.runner import InlineEngine


@pytest.fixture
def new_people(generated: Path, make_project: Callable[..., Project]) -> Callable[[], Project]:
    """Creates projects of the generated people."""
    return lambda: make_project(generated / "people")


@pytest.fixture(scope="session")
def expected(generated: Path, knowing: Callable[..., Detectors], tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The result of the inline engine for the generated people."""
    with create_project(tmp_path_factory.mktemp("inline"), "inline", ("person",)) as project:
        register_recording(project, open_recording(generated / "people"))
        annotate_with(project, InlineEngine(knowing("people")), CONFIG)
        return stored(project)
