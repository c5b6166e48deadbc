"""A real server on 127.0.0.1 with a generated project, and clients of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from live_server import OPERATOR, Live, running, wait_until

from annotator.project import create_project
from annotator.recordings import open_recording
from annotator.web.settings import ServerSettings
from annotator.workflows.recordings import register_recording

__all__ = ["OPERATOR", "Live", "running"]


@pytest.fixture
def wait_for() -> Callable[[Callable[[], Any], float], None]:
    """`wait_for(condition, seconds)`: fails where it does not come true in time."""
    return wait_until


@pytest.fixture
def web_settings(tmp_path: Path, generated: Path) -> ServerSettings:
    """Settings of a server whose project `room` has 5 frames of people (none labelled), folder root `generated`."""
    with create_project(tmp_path / "projects", "room", ("person",)) as project:
        register_recording(project, open_recording(generated / "people"))
    return ServerSettings(tmp_path / "projects", (generated,), port=0)


@pytest.fixture
def live(web_settings: ServerSettings) -> Iterator[Live]:
    """A server of one's own with the project `room`."""
    with running(web_settings) as server:
        yield server
