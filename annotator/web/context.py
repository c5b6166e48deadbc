"""State shared by all routes (settings, open projects, hub, jobs), and the operator of a request."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated
from urllib.parse import unquote

from fastapi import Depends
from starlette.requests import HTTPConnection

from annotator.project import Project, open_project
from annotator.project.config import check_name
from annotator.types import Frame
from annotator.types.errors import AnnotatorError, ConfigError, NotFoundError
from annotator.web.caches import Caches
from annotator.web.errors import NotSignedInError, hide_paths
from annotator.web.folders import Folders
from annotator.web.follow_runs import FollowRuns
from annotator.web.hub import Hub
from annotator.web.jobs.records import Job
from annotator.web.jobs.runner import JobRunner
from annotator.web.server_lock import JOBS_FOLDER
from annotator.web.settings import ServerSettings
from annotator.web.uploads import as_sent

OPERATOR_COOKIE = "annotator_operator"


class Context:
    """The state of one application, in `app.state.context`. Thread-safe.

    Attributes:
        settings: of the server.
        folders: folders that recordings may be added from.
        hub: sends events to the open pages.
        jobs: runs the jobs.
        follow_runs: follow objects through recordings.
        caches: open frames, images of pseudo-views, detectors.
    """

    def __init__(self, settings: ServerSettings) -> None:
        self.settings = settings
        self.folders = Folders(settings.folders)
        self.hub = Hub()
        self.jobs = JobRunner(settings.projects_root / JOBS_FOLDER, self._send_job, self.public_message)
        self.follow_runs = FollowRuns(self.hub, self.public_message)
        self.caches = Caches()
        self._lock = threading.Lock()
        self._projects: dict[str, Project] = {}

    def project(self, name: str) -> Project:
        """The project of that name; it stays open after the first call.

        Raises:
            NotFoundError: no such project.
            ProjectError: it cannot be opened.
        """
        with self._lock:
            project = self._projects.get(name)
            if project is not None and project.path.is_dir():
                return project
            folder = self._folder(name)
            if project is not None:
                self._projects.pop(name).close()
                self.hub.forget(name)
            if not folder.is_dir():
                raise NotFoundError(f"there is no project {name!r}; the start page lists the existing ones")
            self._projects[name] = open_project(folder)
            return self._projects[name]

    def frame(self, project: Project, frame_id: int) -> Frame:
        """A frame with its image and cloud, from the cache if possible.

        Raises:
            NotFoundError: no such frame.
            FrameError: it cannot be read.
        """
        return self.caches.frames.read(project, frame_id)

    def open_projects(self, names: Iterable[str]) -> list[tuple[str, Project]]:
        """The named projects that are open, with their names."""
        with self._lock:
            return [(name, self._projects[name]) for name in names if name in self._projects]

    def all_open_projects(self) -> list[tuple[str, Project]]:
        """All projects that are open, with their names."""
        with self._lock:
            return list(self._projects.items())

    def public_message(self, text: str) -> str:
        """A message for browsers: absolute paths are replaced, so that it names files but not their folders."""
        return as_sent(hide_paths(text, self._path_names()), self.settings.projects_root.absolute().name)

    def _path_names(self) -> Iterator[tuple[Path, str]]:
        yield from self.folders.roots()
        root = self.settings.projects_root.absolute()
        yield from ((path, root.name) for path in (root, root.resolve()))
        with self._lock:
            projects = list(self._projects.values())
        for project in projects:
            # an unreadable project must not hide the original message
            with suppress(AnnotatorError):
                yield from [(recording.path, recording.name) for recording in project.recordings.all()]

    def close(self) -> None:
        """Ends all threads and processes of the application, and closes its projects."""
        self.jobs.close()
        self.follow_runs.close()
        self.hub.close()
        self.caches.close()
        with self._lock:
            for project in self._projects.values():
                project.close()
            self._projects.clear()

    def _send_job(self, job: Job) -> None:
        # no "project" key: the job indicator is on every page
        self.hub.send({"type": "job", "job": job.model_dump(mode="json")})

    def _folder(self, name: str) -> Path:
        try:
            check_name(name)
        except ConfigError as error:
            raise NotFoundError(f"there is no project {name!r}") from error
        return self.settings.projects_root / name


def context(connection: HTTPConnection) -> Context:
    """The application's context, for `Depends`."""
    shared: Context = connection.app.state.context
    return shared


def operator(connection: HTTPConnection) -> str:
    """The signed-in operator's name, for `Depends`.

    Raises:
        NotSignedInError: the browser has not signed in.
    """
    name = operator_or_none(connection)
    if name is None:
        raise NotSignedInError("no operator is signed in; sign in with your name first")
    return name


def operator_or_none(connection: HTTPConnection) -> str | None:
    """The signed-in operator's name, or None."""
    return unquote(connection.cookies.get(OPERATOR_COOKIE, "")) or None


Ctx = Annotated[Context, Depends(context)]
Operator = Annotated[str, Depends(operator)]
