"""What a server does beside requests: watches, learns, looks for still objects, makes backups, loads ahead and returns
memory."""

from __future__ import annotations

import ctypes
import gc
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from weakref import WeakKeyDictionary

from annotator.project import REVIEWED, Project
from annotator.project.backup.make import Reason, back_up_automatically, is_backup_due
from annotator.project.database.store import waiting_at_most
from annotator.types import DetectorKind
from annotator.types.errors import AnnotatorError
from annotator.web.context import Context
from annotator.web.jobs.records import TrainRequest
from annotator.web.jobs.runner import JobRunner
from annotator.workflows.tracks.still_objects import find_sightings
from annotator.workflows.training.model_report import decision_of
from annotator.workflows.warm_up import BOX, warm_frame
from annotator.workflows.workbench.contact_sheet import picture

LOG = logging.getLogger("annotator.web")


class Periodic:
    """A thread that calls a function at fixed intervals, the first time after one."""

    def __init__(self, name: str, every_s: float, call: Callable[[], object]) -> None:
        self._name, self._every_s, self._call = name, every_s, call
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        self._thread.start()

    @property
    def is_ending(self) -> bool:
        """Whether `close` was called."""
        return self._ended.is_set()

    def close(self) -> None:
        """Ends the thread, and waits for a call that it is making."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(self._every_s):
            try:
                self._call()
            except Exception:  # a failed call must not end the thread
                LOG.exception("%s: failed, and is tried again in %g s", self._name, self._every_s)


class Problems:
    """Logs what is wrong with a project once, not each time that it is looked at."""

    def __init__(self) -> None:
        self._last: dict[str, str] = {}

    @contextmanager
    def of(self, name: str, what: str) -> Iterator[None]:
        """An error in the block is logged, unless it was the last time; `what` cannot be done, in words."""
        try:
            yield
        except AnnotatorError as error:
            if self._last.get(name) != str(error):
                LOG.warning("%s: %s: %s", name, what, error)
            self._last[name] = str(error)
        else:
            self._last.pop(name, None)


MOST_HEAPS, TIDY_EVERY_S = 2, 60.0
# `M_ARENA_MAX` of glibc's malloc.h
_ARENA_MAX = -8


@contextmanager
def tidy_heaps(every_s: float = TIDY_EVERY_S) -> Iterator[None]:
    """During the block, threads share few heaps, free memory is returned, and loaded modules are set aside.

    By default glibc gives up to eight heaps per processor to threads. Each keeps the pieces that earlier requests have
    freed: in a soak, 230 of 820 MB after two minutes, while the memory in use stayed the same. Other C libraries are
    left alone.

    A full garbage collection looks at every object, and no request is answered meanwhile: with torch and OpenVINO
    loaded, up to 0.5 s. What modules hold is never garbage, so it is left out after new ones were loaded.
    """
    number = 0

    def tidy() -> None:
        nonlocal number
        if len(sys.modules) != number:
            # This leaves out all objects in use: they stay, even if they become cyclic garbage.
            number = len(sys.modules)
            gc.collect()
            gc.freeze()
        _call("malloc_trim", 0)

    _call("mallopt", _ARENA_MAX, MOST_HEAPS)
    periodic = Periodic("heaps", every_s, tidy)
    periodic.start()
    try:
        yield
    finally:
        periodic.close()
        gc.unfreeze()


def _call(name: str, *values: int) -> None:
    if sys.platform == "linux":
        # other C libraries do not have these functions
        with suppress(OSError, AttributeError):
            getattr(ctypes.CDLL(None), name)(*values)


def preload() -> threading.Thread:
    """Starts a thread that loads the library of the 3D view and the compiled functions that draw a frame."""
    thread = threading.Thread(target=_load, name="preload", daemon=True)
    thread.start()
    return thread


def _load() -> None:
    try:
        # counts points and draws views, as every page does
        picture(warm_frame(), BOX)
        import_module("viser")
    except Exception:  # the page shows it when it needs this
        LOG.exception("loading ahead failed")


BACKUPS_EVERY_S = 60.0
# A failed backup is tried again after this time, for it may have copied much before it failed.
BACKUPS_PAUSE_S = 3600.0


class AutomaticBackups(Periodic):
    """Looks once a minute which projects are due. Nobody waits for it: a backup only reads."""

    def __init__(self, context: Context, seconds: Callable[[], float] = time.monotonic) -> None:
        super().__init__("automatic backups", BACKUPS_EVERY_S, self.make_due)
        self._context, self._seconds = context, seconds
        # when to try again, by project whose last backup failed
        self._paused = WeakKeyDictionary[Project, float]()

    def make_due(self) -> None:
        """Backs up every open project that is due."""
        for name, project in self._context.all_open_projects():
            if self._seconds() < self._paused.get(project, 0.0):
                continue
            try:
                if is_backup_due(project.path, project.store):
                    back_up_automatically(project.path, Reason.CHANGES)
                self._paused.pop(project, None)
            except AnnotatorError as error:
                LOG.warning("%s: no automatic backup could be made; the next try is in an hour: %s", name, error)
                self._paused[project] = self._seconds() + BACKUPS_PAUSE_S


OPERATOR = "learning while labelling"
ROUND = TrainRequest(kind="train", roles=[DetectorKind.VIEW], background=True)


class Learner:
    """Starts a round for a project once enough boxes were reviewed since the last one."""

    def __init__(self, jobs: JobRunner) -> None:
        self._jobs = jobs
        # number of reviewed boxes when the last round began
        self._learned = WeakKeyDictionary[Project, int]()

    def look(self, name: str, project: Project) -> None:
        """Starts a round of a project if it is due and no other job runs or waits."""
        every = project.config.settings.learn_every
        if every is None:
            self._learned.pop(project, None)
            return
        reviewed = project.labels.count(REVIEWED)
        if project not in self._learned:
            self._learned[project] = _learned(project, reviewed)
        learned = self._learned[project]
        if reviewed - learned < every or not self._jobs.is_idle():
            return
        # a training that somebody started has learned, too
        learned = self._learned[project] = max(learned, _learned(project, learned))
        if reviewed - learned >= every:
            request = ROUND.model_copy(update={"minutes": project.config.settings.learn_minutes})
            self._jobs.add(name, project.path, request, OPERATOR)
            self._learned[project] = reviewed


def _learned(project: Project, reviewed: int) -> int:
    """The number of reviewed boxes when the training of the newest detector began; 0 without a detector.

    Args:
        reviewed: the number that counts for a detector without a record of it.
    """
    models = project.models.all(DetectorKind.VIEW)
    if not models:
        return 0
    decision = decision_of(models[-1])
    return reviewed if decision is None or decision.reviewed is None else decision.reviewed


SIGHTS_EVERY_S = 0.5


class Sights(Periodic):
    """Looks which frames see the objects that stand still, in the projects that a page has open: first in the frames
    around one that is shown. Pages are told as more is found."""

    def __init__(self, context: Context) -> None:
        super().__init__("still objects", SIGHTS_EVERY_S, self.look)
        self._context = context
        # for which still objects of each rig, and among how many frames of the project, all was looked at
        self._done = WeakKeyDictionary[Project, dict[int, tuple[tuple[int, int], int]]]()
        self._problems = Problems()

    def look(self) -> None:
        """Looks at every project that a page has open, until its still objects change or the server ends."""
        for name in filter(self._context.is_open, self._context.hub.projects()):
            with self._problems.of(name, "its still objects could not be looked for"):
                project = self._context.project(name)
                stills = project.stills.versions()
                frames = project.frames.count_present() if stills else 0
                for rig, version in stills.items():
                    known = version, frames
                    if self._done.setdefault(project, {}).get(rig) != known and self._look(name, project, rig):
                        self._done[project][rig] = known

    def _look(self, name: str, project: Project, rig: int) -> bool:
        """Looks in a rig's frames; returns whether it was looked in all of them."""
        begun = project.stills.versions().get(rig)
        wait_s, next_s = SIGHTS_EVERY_S, time.monotonic() + SIGHTS_EVERY_S

        def tell(done: int, total: int) -> None:
            # less and less often: what is near the shown frame was found first
            nonlocal wait_s, next_s
            if 0 < done == total or time.monotonic() > next_s:
                self._context.announcer.tell_still(project)
                wait_s, next_s = 2 * wait_s, time.monotonic() + 2 * wait_s

        def is_stopped() -> bool:
            return self.is_ending or project.stills.versions().get(rig) != begun

        shown = [int(frame) for frame in self._context.hub.presence(name)]
        find_sightings(project, rig, near=next(iter(shown), None), progress=tell, is_stopped=is_stopped)
        return not is_stopped()


WATCH_EVERY_S = 0.5
# For a locked project: the other projects wait meanwhile.
WATCH_WAIT_S = 0.1


class Watch(Periodic):
    """Announces what other processes have changed in the projects that a page has open, and lets these learn."""

    def __init__(self, context: Context, learner: Learner) -> None:
        super().__init__("watch", WATCH_EVERY_S, self.poll)
        self._context, self._learner = context, learner
        self._problems = Problems()

    def poll(self) -> None:
        """Looks at every project that a page has open."""
        for name in filter(self._context.is_open, self._context.hub.projects()):
            with self._problems.of(name, "it cannot be watched, or cannot learn"), waiting_at_most(WATCH_WAIT_S):
                project = self._context.project(name)
                self._context.announcer.announce(project)
                self._learner.look(name, project)
