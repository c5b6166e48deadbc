"""Runs that follow objects, or fit the boxes that have filled a gap: each in a thread of the server, at most one per
project and operator.

A job would wait behind a training, and would have to start a process first. Here the first box appears at once. Each
new box is stored at once, and all pages are told.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal
from weakref import WeakKeyDictionary

from annotator.project import Project
from annotator.types.errors import AnnotatorError, ConfigError
from annotator.web.errors import INTERNAL
from annotator.web.hub import Announcer, Hub
from annotator.web.schemas import Schema
from annotator.workflows.tracks.follow_objects import FollowedTrack
from annotator.workflows.tracks.follow_run import Following, FollowRun
from annotator.workflows.tracks.refit_run import RefitRun

LOG = logging.getLogger("annotator.web")

Direction = Literal["forward", "backward"]


class FollowRunJson(Schema):
    """A run.

    Attributes:
        number: of the run; a later run has a higher one, also after a restart of the server.
        frame: id of the frame from which objects are followed.
        direction: in time; "between": the boxes that have filled a gap are fitted.
        has_detector: whether the project's view detector measures the boxes; otherwise they keep the reviewed size.
        done, total: numbers of frames; a frame counts once for each object and direction.
        first: frame id and uid of the first new box, or null.
        message: why it failed, or null.
    """

    number: int
    operator: str
    frame: int
    direction: Direction | Literal["between"]
    has_detector: bool
    state: Literal["running", "done", "stopped", "failed", "undone"]
    done: int
    total: int
    tracks: tuple[FollowedTrack, ...]
    first: tuple[int, str] | None
    message: str | None


@dataclass(eq=False)
class _Running:
    shown: FollowRunJson
    action: str
    stop: threading.Event = field(default_factory=threading.Event)
    thread: threading.Thread | None = None


class FollowRuns:
    """Starts, stops and remembers runs. Thread-safe."""

    def __init__(self, hub: Hub, announcer: Announcer, public_message: Callable[[str], str]) -> None:
        self._hub, self._announcer, self._public_message = hub, announcer, public_message
        self._lock, self._starting = threading.Lock(), threading.Lock()
        self._number = 0
        # the latest run of each operator; not by the project's name: another one of that name has none of them
        self._runs = WeakKeyDictionary[Project, dict[str, _Running]]()

    def start(
        self,
        project: Project,
        operator: str,
        run: FollowRun | RefitRun,
        frame_id: int,
        direction: Direction | Literal["between"],
        has_detector: bool,
    ) -> FollowRunJson:
        """Starts a run, described as in `FollowRunJson`; an earlier one of the operator in this project is stopped."""
        with self._starting:
            self.stop(project, operator)
            with self._lock:
                # milliseconds, so that the numbers grow across restarts of the server
                self._number = max(self._number + 1, time.time_ns() // 1_000_000)
                state = run.state
                shown = FollowRunJson(
                    number=self._number,
                    operator=operator,
                    frame=frame_id,
                    direction=direction,
                    has_detector=has_detector,
                    state="running",
                    done=state.done,
                    total=state.total,
                    tracks=_tracks(state, self._public_message),
                    first=None,
                    message=None,
                )
                running = self._runs.setdefault(project, {})[operator] = _Running(shown, run.action)
                running.thread = threading.Thread(
                    target=self._follow, args=(project, running, run), name="follow", daemon=True
                )
                running.thread.start()
            return shown

    def latest(self, project: Project, operator: str) -> FollowRunJson | None:
        """The operator's latest run in a project, or None."""
        with self._lock:
            running = self._runs.get(project, {}).get(operator)
            return None if running is None else running.shown

    def require_none(self, project: Project, operator: str) -> None:
        """Refuses what would end the operator's run, unless it has ended."""
        if (latest := self.latest(project, operator)) is not None and latest.state == "running":
            what = "filled boxes are still being fitted" if latest.direction == "between" else "objects are followed"
            raise ConfigError(f"{what}; wait for the end, or stop it, and then fit these boxes")

    def stop(self, project: Project, operator: str) -> FollowRunJson | None:
        """Stops the operator's run, and waits until its last box is stored; its boxes stay."""
        with self._lock:
            running = self._runs.get(project, {}).get(operator)
        if running is None:
            return None
        running.stop.set()
        if running.thread is not None:
            running.thread.join()
        return running.shown

    def forget(self, project: Project, operator: str, action: str) -> None:
        """Forgets the operator's run if it was this action, since its boxes were taken back."""
        with self._lock:
            running = self._runs.get(project, {}).get(operator)
            if running is not None and running.action == action:
                del self._runs[project][operator]
                self._tell(project, running.shown.model_copy(update={"state": "undone"}))

    def close(self, project: Project | None = None) -> None:
        """Stops and forgets all runs, or those of one project."""
        with self._lock:
            runs = {one: list(self._runs.get(one, ())) for one in (self._runs.keys() if project is None else [project])}
        for one, operators in runs.items():
            for operator in operators:
                self.stop(one, operator)
            with self._lock:
                self._runs.pop(one, None)

    def _follow(self, project: Project, running: _Running, run: FollowRun | RefitRun) -> None:
        def report(state: Following) -> None:
            self._announcer.announce(project)
            self._show(project, running, state)

        try:
            end = run.run(report, running.stop.is_set)
            self._show(project, running, end, state="stopped" if end.done < end.total else "done")
        except AnnotatorError as error:
            self._show(project, running, run.state, state="failed", message=self._public_message(str(error)))
        except Exception:
            LOG.exception("following in project %s failed", project.path.name)
            self._show(project, running, run.state, state="failed", message=INTERNAL)

    def _show(self, project: Project, running: _Running, now: Following, **changes: object) -> None:
        """Updates a run, and sends it to the pages of its project."""
        tracks = _tracks(now, self._public_message)
        values = {"done": now.done, "total": now.total, "tracks": tracks, "first": now.first, **changes}
        with self._lock:
            running.shown = running.shown.model_copy(update=values)
            self._tell(project, running.shown)

    def _tell(self, project: Project, run: FollowRunJson) -> None:
        self._hub.send({"type": "follow", "project": project.path.name, "run": run.model_dump(mode="json")})


def _tracks(state: Following, public_message: Callable[[str], str]) -> tuple[FollowedTrack, ...]:
    """The tracks, with reasons for browsers."""
    return tuple(
        replace(track, stops=tuple(replace(at, reason=public_message(at.reason)) for at in track.stops))
        for track in state.tracks
    )
