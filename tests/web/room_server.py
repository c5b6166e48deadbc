"""Fixtures: a real server on 127.0.0.1 with a generated project. Folders of tests import them into their conftest."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from live_server import Live, running

from annotator.project import create_project
from annotator.recordings import open_recording
from annotator.web.security import ServerSettings
from annotator.workflows.add_recordings import register_recording


@pytest.fixture
def web_settings(tmp_path: Path, generated: Path) -> ServerSettings:
    """Settings of a server with the project `room` of 5 unlabelled frames of people, and the folder `generated`."""
    with create_project(tmp_path / "projects", "room", ("person",)) as project:
        register_recording(project, open_recording(generated / "people"))
    return ServerSettings(tmp_path / "projects", (generated,), port=0)


@pytest.fixture
def live(web_settings: ServerSettings) -> Iterator[Live]:
    """A server for one test, with the project `room`; its client has signed in."""
    with running(web_settings) as server:
        yield server
