"""State shared by all routes (settings, open projects, hub, jobs), and the operator of a request."""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated
from urllib.parse import unquote

from fastapi import Depends
from starlette.requests import HTTPConnection

from annotator.project import Project, StoredRecording, open_project
from annotator.project.config import check_name
from annotator.project.database.store import BUSY_TIMEOUT_S, patience_s, waiting_at_most
from annotator.recordings import Recording
from annotator.types.errors import AnnotatorError, ConfigError, NotFoundError, ProjectError
from annotator.web.errors import NotSignedInError, hide_paths, without_commands
from annotator.web.folders import JOBS_FOLDER, Folders
from annotator.web.follow_runs import FollowRuns
from annotator.web.hub import Announcer, Hub
from annotator.web.jobs.records import Job, require_own_files
from annotator.web.jobs.runner import JobRunner
from annotator.web.security import ServerSettings, is_loopback
from annotator.web.uploads import as_sent
from annotator.workflows.sample import SAMPLES
from annotator.workflows.workbench.contact_sheet import SheetPictures
from annotator.workflows.workbench.drawing_steps import WholeBoxes
from annotator.workflows.workbench.frame_cache import FrameCache, Memo
from annotator.workflows.workbench.loaded_detectors import ReadyDetectors

LOG = logging.getLogger("annotator.web")

# The image of a pseudo-view takes some 30 kB, what is seen of a project's objects up to 60 MB.
MOST_IMAGES, MOST_PROJECTS = 1000, 4


class Caches:
    """The caches of one application.

    Attributes:
        view_images: the latest PNG images of pseudo-views, by the id that `project.views.store` gives them.
    """

    def __init__(self) -> None:
        self.frames = FrameCache()
        self.view_images = Memo(MOST_IMAGES)
        self.sheets = SheetPictures(self.frames)
        self.detectors = ReadyDetectors()
        self._whole = Memo(MOST_PROJECTS)

    def whole_boxes(self, project: Project) -> WholeBoxes:
        """What offers whole boxes for the drawn objects of a project."""
        return self._whole.get(project, lambda: WholeBoxes(project, partial(self.frames.look, project)))

    def close(self) -> None:
        self.frames.close()
        self.sheets.close()
        self.detectors.close()


OPERATOR_COOKIE = "annotator_operator"
LONGEST_NAME = 64


class Context:
    """The state of one application, in `app.state.context`. Thread-safe."""

    def __init__(self, settings: ServerSettings) -> None:
        self.settings = settings
        self.folders = Folders(settings.folders)
        self.hub = Hub()
        self.announcer = Announcer(self.hub)
        self._temporary: Path | None = None
        # other people must not see more recordings than those they could add, whatever a project names
        samples = settings.projects_root / SAMPLES
        require_own_files(samples)
        readable = (*settings.folders, samples)
        self._readable = None if is_loopback(settings.host) else tuple(path.resolve() for path in readable)
        self.jobs = JobRunner(self._jobs_folder(), self._send_job, self.public_message, readable=self._readable)
        self.follow_runs = FollowRuns(self.hub, self.announcer, self.public_message)
        self.caches = Caches()
        self._lock = threading.Lock()
        self._projects: dict[str, Project] = {}
        self._opens: dict[str, threading.Lock] = {}

    def project(self, name: str) -> Project:
        """The project of that name; it stays open after the first call, but is opened anew once it was replaced."""
        project = self._projects.get(name)
        if project is not None and project.is_current:
            return project
        folder = self._folder(name)
        if project is None:
            _require(folder)
        with self._opening(name):
            project = self._projects.get(name)
            if project is not None and project.is_current:
                return project
            if project is not None:
                self._drop(name)
            _require(folder)
            project = open_project(folder, readable=self._readable)
            self.announcer.begin(project)
            with self._lock:
                self._projects[name] = project
            return project

    @contextmanager
    def closed(self, name: str) -> Iterator[Path]:
        """Closes a project, which no request can open within the block; yields its folder."""
        folder = self._folder(name)
        _require(folder)
        self.jobs.require_none(name)
        if (project := self._projects.get(name)) is not None:
            self.follow_runs.close(project)
        with self._opening(name):
            _require(folder)
            if name in self._projects:
                self._close(name)
            yield folder

    def is_open(self, name: str) -> bool:
        """True if the project of that name has been opened."""
        return name in self._projects

    def all_open_projects(self) -> list[tuple[str, Project]]:
        """All projects that are open, with their names."""
        with self._lock:
            return list(self._projects.items())

    def public_message(self, text: str) -> str:
        """A message for browsers: it names files but not their folders, and no command of the terminal."""
        return self.without_paths(without_commands(text))

    def without_paths(self, text: str) -> str:
        """A message whose absolute paths are replaced, so that it names files but not their folders."""
        return as_sent(hide_paths(text, self._path_names()), self.settings.projects_root.absolute().name)

    def public(self, text: str | None) -> str | None:
        """As `public_message`, for a message that may be missing."""
        return None if text is None else self.public_message(text)

    def _path_names(self) -> Iterator[tuple[Path, str]]:
        yield from self.folders.roots()
        root = self.settings.projects_root.absolute()
        yield from ((path, root.name) for path in (root, root.resolve()))
        with self._lock:
            projects = list(self._projects.values())
        for project in projects:
            # an unreadable or locked project must neither hide the original message nor delay it
            recordings: tuple[StoredRecording, ...] = ()
            with suppress(AnnotatorError), waiting_at_most(0.0):
                recordings = (*project.recordings.all(), *project.recordings.removed())
            yield from ((recording.path, recording.name) for recording in recordings)

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
        if self._temporary is not None:
            shutil.rmtree(self._temporary, ignore_errors=True)

    def _jobs_folder(self) -> Path:
        """The folder of jobs; a temporary one if the projects folder cannot be written, so that exports work."""
        root = self.settings.projects_root
        if root.is_dir() and not os.access(root, os.W_OK):
            self._temporary = Path(tempfile.mkdtemp(prefix="annotator-jobs-"))
            return self._temporary
        return root / JOBS_FOLDER

    @contextmanager
    def _opening(self, name: str) -> Iterator[None]:
        """Held by the thread that opens a project: others wait for that project only."""
        with self._lock:
            lock = self._opens.setdefault(name, threading.Lock())
        ends_s = time.monotonic() + patience_s(BUSY_TIMEOUT_S)
        if not lock.acquire(timeout=patience_s(BUSY_TIMEOUT_S)):
            raise ProjectError(f"project {name} is locked by another process; wait, and try again")
        try:
            with waiting_at_most(max(0.0, ends_s - time.monotonic())):
                yield
        finally:
            lock.release()

    def _drop(self, name: str) -> None:
        """Closes a project that was removed or replaced by another process."""
        LOG.warning("%s: was removed or replaced while it was open; it is opened anew", self._folder(name))
        self._close(name)
        # revisions that a page has seen may be newer than the stored ones
        self.hub.send({"type": "replaced", "project": name})

    def _close(self, name: str) -> None:
        with self._lock:
            project = self._projects.pop(name)
        self.caches.frames.forget(project)
        project.close()

    def _send_job(self, job: Job) -> None:
        # no "project" key: the job indicator is on every page
        self.hub.send({"type": "job", "job": job.model_dump(mode="json")})

    def _folder(self, name: str) -> Path:
        try:
            check_name(name)
        except ConfigError as error:
            raise NotFoundError(f"there is no project {name!r}") from error
        return self.settings.projects_root / name


def _require(folder: Path) -> None:
    if not folder.is_dir():
        raise NotFoundError(f"there is no project {folder.name!r}; the start page lists the existing ones")


# These are coroutines, since FastAPI calls plain functions in a thread of their own, for which a request waits.
async def context(connection: HTTPConnection) -> Context:
    """The application's context, for `Depends`."""
    shared: Context = connection.app.state.context
    return shared


async def operator(connection: HTTPConnection) -> str:
    """The signed-in operator's name, for `Depends`."""
    name = operator_or_none(connection)
    if name is None:
        raise NotSignedInError("no operator is signed in; sign in with your name first")
    return name


def operator_or_none(connection: HTTPConnection) -> str | None:
    """The signed-in operator's name; None without one, or if the cookie holds what sign-in refuses."""
    try:
        return check_operator(unquote(connection.cookies.get(OPERATOR_COOKIE, ""), errors="strict"))
    except ValueError:
        return None


def check_operator(name: str) -> str:
    """Returns an operator's name without spaces around it."""
    name = name.strip()
    if not 0 < len(name) <= LONGEST_NAME or not name.isprintable():
        raise ValueError(f"a name has 1 to {LONGEST_NAME} printable characters")
    return name


Ctx = Annotated[Context, Depends(context)]
Operator = Annotated[str, Depends(operator)]


@dataclass(eq=False)
class InProject:
    """A request about a project: the application, the project's name and the operator who asks."""

    ctx: Context
    name: str
    operator: str
    _project: Project | None = field(default=None, init=False)

    @property
    def project(self) -> Project:
        """The project, opened on use: in the thread of the route."""
        # no `cached_property`: up to Python 3.11, all requests share its lock
        if self._project is None:
            self._project = self.ctx.project(self.name)
        return self._project

    def recording(self, recording_id: int) -> Recording:
        """An open recording, which is kept."""
        return self.ctx.caches.frames.recording(self.project, recording_id)

    def announce(self) -> None:
        """Tells the pages of the project what this request has changed."""
        # it is stored; what cannot be read now is announced by the thread that watches
        with suppress(AnnotatorError):
            self.ctx.announcer.announce(self.project, self.operator)


async def _in_project(ctx: Ctx, name: str, operator: Operator) -> InProject:
    return InProject(ctx, name, operator)


AtProject = Annotated[InProject, Depends(_in_project)]
