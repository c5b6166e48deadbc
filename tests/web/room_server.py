"""Fixtures: a real server on 127.0.0.1 with a generated project. Folders of tests import them into their conftest."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from live_server import OPERATOR, Live, running, wait_until

from annotator.project import create_project
from annotator.recordings import open_recording
from annotator.web.security import ServerSettings
from annotator.workflows.add_recordings import register_recording


@pytest.fixture(scope="session")
def projects_with_room(made_once: Callable[[str, Callable[[Path], object]], Path], generated: Path) -> Path:
    """A folder of projects with `room`, which has 5 unlabelled frames of people; do not change it."""

    def fill(folder: Path) -> None:
        with create_project(folder, "room", ("person",)) as project:
            register_recording(project, open_recording(generated / "people"))

    return made_once("projects_with_room", fill)


@pytest.fixture
def web_settings(tmp_path: Path, generated: Path, projects_with_room: Path) -> ServerSettings:
    """Settings of a server with the project `room` of 5 unlabelled frames of people, and the folder `generated`."""
    shutil.copytree(projects_with_room, tmp_path / "projects")
    return ServerSettings(tmp_path / "projects", (generated,), port=0)


@pytest.fixture
def own_live(web_settings: ServerSettings) -> Iterator[Live]:
    """A server for one test, with the project `room`; its client has signed in."""
    with running(web_settings) as server:
        yield server


@pytest.fixture(scope="module")
def live_of_file(tmp_path_factory: pytest.TempPathFactory, generated: Path) -> Iterator[Live]:
    """A server for one file of tests, without projects."""
    projects = tmp_path_factory.mktemp("server") / "projects"
    projects.mkdir()
    with running(ServerSettings(projects, (generated,), port=0)) as server:
        yield server


@pytest.fixture
def live(live_of_file: Live, projects_with_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Live:
    """The server of the file as after a start, with a new project `room` only; its client has signed in."""
    context, root = live_of_file.context, live_of_file.settings.projects_root
    viewports = live_of_file.server.app.state.viewports
    for viewport in list(viewports._open.values()):
        viewports.close_one(viewport.id, viewport.operator)
    for job in context.jobs.all():
        if not job.state.ended:
            context.jobs.cancel(job.id)
    wait_until(lambda: context.jobs.is_idle() and not context.jobs._tasks)
    context.jobs._jobs.clear()
    before = tmp_path_factory.mktemp("before")
    for path in root.iterdir():
        if context.is_open(path.name):
            with context.closed(path.name):
                pass
        if path.name != ".jobs":  # it has the server's lock
            # not removed in place: a thread of the last test may still read ahead into the project's cache
            path.rename(before / path.name)
    shutil.copytree(projects_with_room, root, dirs_exist_ok=True)
    live_of_file.client.cookies.clear()
    assert live_of_file.client.post("/api/session", json={"operator": OPERATOR}).status_code == 200
    return live_of_file
