"""Fixtures of a server with a generated project, and of what its jobs and Review use."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from job_threads import WorkerThread
from live_server import PATIENCE_S, Live, wait_until
from room_server import live, live_of_file, own_live, projects_with_room, web_settings

from annotator.project import Project
from annotator.types import BoxKind
from annotator.web.jobs import runner
from annotator.workflows.detectors import Detectors
from annotator.workflows.tracks.follow_objects import Follower
from annotator.workflows.workbench.loaded_detectors import Readiness, ReadyDetector, ReadyDetectors

__all__ = ["live", "live_of_file", "own_live", "projects_with_room", "web_settings"]


@pytest.fixture
def project(live: Live) -> Project:
    """The project `room` of the server."""
    return live.context.project("room")


@pytest.fixture
def wait_for() -> Callable[[Callable[[], Any]], None]:
    """`wait_for(condition)`: fails unless the condition becomes true within a generous time."""
    return wait_until


@pytest.fixture
def jobs_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worker processes can import `fake_jobs` and `knowing_jobs`."""
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))


@pytest.fixture
def in_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs run in threads of this process."""
    monkeypatch.setattr(runner, "WorkerProcess", WorkerThread)


@pytest.fixture
def following_view(knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch) -> None:
    """Following uses a perfect view detector in all projects."""
    ready = ReadyDetector(knowing("people").view, BoxKind.BOX, threading.Lock())
    monkeypatch.setattr("annotator.web.routes.tracks.has_view_with_classes", lambda _: True)
    monkeypatch.setattr(ReadyDetectors, "readiness", lambda *_: Readiness("ready", ready))


@pytest.fixture
def following_gate(monkeypatch: pytest.MonkeyPatch) -> threading.Semaphore:
    """Following waits here before each frame."""
    passes, step = threading.Semaphore(0), Follower.step

    def wait(follower: Follower, moment: Any) -> Any:
        assert passes.acquire(timeout=PATIENCE_S)
        return step(follower, moment)

    monkeypatch.setattr(Follower, "step", wait)
    return passes
