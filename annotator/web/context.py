"""What all routes share: the settings, the open projects, the hub, the jobs; and who asks."""

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
from annotator.web.annotation import Annotation
from annotator.web.errors import NotSignedInError, without_places
from annotator.web.folders import Folders
from annotator.web.hub import Hub
from annotator.web.jobs.records import Job
from annotator.web.jobs.runner import JobRunner
from annotator.web.settings import ServerSettings

OPERATOR_COOKIE = "annotator_operator"
# Beside the projects; hidden, so that it is none.
JOBS_FOLDER = ".jobs"


class Context:
    """One for each application, in `app.state.context`; threads share it.

    Attributes:
        settings: what the server was told.
        folders: where recordings may be added from.
        hub: events to the open pages.
        jobs: long work.
        annotation: open frames and pictures.
    """

    def __init__(self, settings: ServerSettings) -> None:
        self.settings = settings
        self.folders = Folders(settings.folders)
        self.hub = Hub()
        self.jobs = JobRunner(settings.projects_root / JOBS_FOLDER, self._tell_job, self.told)
        self.annotation = Annotation()
        self._lock = threading.Lock()
        self._projects: dict[str, Project] = {}

    def project(self, name: str) -> Project:
        """The project of that name, opened once and kept open.

        Raises:
            NotFoundError: there is none.
            ProjectError: it cannot be opened.
        """
        with self._lock:
            known = self._projects.get(name)
            if known is not None and known.path.is_dir():
                return known
            folder = self._folder(name)
            if known is not None:
                self._projects.pop(name).close()
                self.hub.forget(name)
            if not folder.is_dir():
                raise NotFoundError(f"there is no project {name!r}; the start page lists those there are")
            self._projects[name] = open_project(folder)
            return self._projects[name]

    def frame(self, project: Project, frame_id: int) -> Frame:
        """A frame with its image and cloud; the last few are kept.

        Raises:
            NotFoundError: no such frame.
            FrameError: it cannot be read.
        """
        return self.annotation.frames.read(project, frame_id)

    def open_projects(self, names: Iterable[str]) -> list[tuple[str, Project]]:
        """Those of these projects that are open already."""
        with self._lock:
            return [(name, self._projects[name]) for name in names if name in self._projects]

    def told(self, text: str) -> str:
        """A message as a browser may read it: files are named, but not where on this computer they are."""
        return without_places(text, self._places())

    def _places(self) -> Iterator[tuple[Path, str]]:
        yield from self.folders.places()
        root = self.settings.projects_root.absolute()
        yield from ((path, root.name) for path in (root, root.resolve()))
        with self._lock:
            projects = list(self._projects.values())
        for project in projects:
            # a project whose recordings cannot be read has told so already
            with suppress(AnnotatorError):
                yield from [(recording.path, recording.name) for recording in project.recordings.all()]

    def close(self) -> None:
        """Ends everything that runs on behalf of the application."""
        self.jobs.close()
        self.hub.close()
        self.annotation.close()
        with self._lock:
            for project in self._projects.values():
                project.close()
            self._projects.clear()

    def _tell_job(self, job: Job) -> None:
        # the indicator of jobs is on every page, whatever project it shows
        self.hub.send({"type": "job", "job": job.model_dump(mode="json")})

    def _folder(self, name: str) -> Path:
        try:
            check_name(name)
        except ConfigError as error:
            raise NotFoundError(f"there is no project {name!r}") from error
        return self.settings.projects_root / name


def context(connection: HTTPConnection) -> Context:
    """The application's context, for `Depends`."""
    found: Context = connection.app.state.context
    return found


def operator(connection: HTTPConnection) -> str:
    """The signed-in operator's name, for `Depends`.

    Raises:
        NotSignedInError: nobody has signed in on this browser.
    """
    name = operator_or_none(connection)
    if name is None:
        raise NotSignedInError("nobody is signed in; say your name first")
    return name


def operator_or_none(connection: HTTPConnection) -> str | None:
    """The signed-in operator's name, or None."""
    return unquote(connection.cookies.get(OPERATOR_COOKIE, "")) or None


Ctx = Annotated[Context, Depends(context)]
Operator = Annotated[str, Depends(operator)]
