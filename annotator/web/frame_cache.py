"""The frames that are looked at now, kept ready: image, cloud, and what is computed from them once."""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass

from annotator.project import Project, StoredFrame
from annotator.project.overview import neighbours
from annotator.types import Frame
from annotator.types.errors import AnnotatorError, FrameError
from annotator.workflows.frames import FrameSource
from annotator.workflows.open_frame import OpenFrame

LOG = logging.getLogger("annotator.web")

# A few operators, each with the frame they look at, the one before and the next.
FRAMES_KEPT = 8
# What is not asked for yet waits until what is asked for has had the processor, seconds.
PAUSE_S = 0.4


@dataclass(frozen=True, eq=False)
class _Wanted:
    """The frame that an operator looks at, and when what is beside it may be read (`time.monotonic`)."""

    project: Project
    stored: StoredFrame
    due_s: float

    @property
    def key(self) -> tuple[Project, int]:
        return self.project, self.stored.id


class FrameCache:
    """Reads frames once and keeps the last few; the ones beside each are read ahead. Threads share it."""

    def __init__(self, kept: int = FRAMES_KEPT) -> None:
        self._kept = kept
        self._lock = threading.Lock()
        self._frames: OrderedDict[tuple[Project, int], OpenFrame] = OrderedDict()
        self._sources: dict[Project, tuple[threading.Lock, FrameSource]] = {}
        self._ahead = ThreadPoolExecutor(1, "read-ahead")
        # one an operator, the newest: no frame is kept for its sake
        self._waiting: dict[str, _Wanted] = {}
        self._is_reading_ahead = False
        self._closed = threading.Event()

    def read(self, project: Project, frame_id: int) -> Frame:
        """A frame.

        Raises:
            NotFoundError: no such frame.
            FrameError, RecordingError: it cannot be read.
        """
        return self.open(project, frame_id).frame

    def open(self, project: Project, frame_id: int, who: str = "") -> OpenFrame:
        """A frame with what is computed from it; as `read`.

        Args:
            who: looks at it; what they looked at before needs no reading ahead any more.
        """
        stored = project.frames.get(frame_id)
        found = self._open(project, stored)
        self._read_ahead(_Wanted(project, stored, time.monotonic() + PAUSE_S), who)
        return found

    def forget(self, project: Project) -> None:
        """Lets go of all frames of a project, as after its recordings have changed."""
        with self._lock:
            self._sources.pop(project, None)
            for key in [key for key in self._frames if key[0] is project]:
                del self._frames[key]

    def close(self) -> None:
        """Ends the reading ahead."""
        self._closed.set()
        self._ahead.shutdown(wait=False, cancel_futures=True)

    def _known(self, key: tuple[Project, int]) -> OpenFrame | None:
        with self._lock:
            if key in self._frames:
                self._frames.move_to_end(key)
            return self._frames.get(key)

    def _open(self, project: Project, stored: StoredFrame) -> OpenFrame:
        key = (project, stored.id)
        found = self._known(key)
        if found is not None:
            return found
        lock, source = self._source(project)
        # one frame of a project at a time: who waits finds it read
        with lock:
            found = self._known(key)
            if found is not None:
                return found
            found = OpenFrame(self._read(project, source, stored))
        with self._lock:
            self._frames[key] = found
            while len(self._frames) > self._kept:
                self._frames.popitem(last=False)
        return found

    def _read(self, project: Project, source: FrameSource, stored: StoredFrame) -> Frame:
        try:
            return source.read(stored)
        except FrameError:
            # the recording may have grown since it was opened; a frame that is broken fails again
            with self._lock:
                lock, _ = self._sources[project]
                self._sources[project] = (lock, FrameSource(project))
                source = self._sources[project][1]
            return source.read(stored)

    def _source(self, project: Project) -> tuple[threading.Lock, FrameSource]:
        with self._lock:
            if project not in self._sources:
                self._sources[project] = (threading.Lock(), FrameSource(project))
            return self._sources[project]

    def _read_ahead(self, wanted: _Wanted, who: str) -> None:
        with self._lock:
            known = self._waiting.get(who)
            if known is None or known.key != wanted.key:
                self._waiting[who] = wanted
            if self._is_reading_ahead:
                return
            # after `close` nothing is read ahead any more
            with suppress(RuntimeError):
                self._ahead.submit(self._prepare_all)
                self._is_reading_ahead = True

    def _prepare_all(self) -> None:
        """One frame after the other, each once its operator has stayed with it for a moment."""
        while not self._closed.is_set():
            with self._lock:
                if not self._waiting:
                    self._is_reading_ahead = False
                    return
                who, wanted = min(self._waiting.items(), key=lambda entry: entry[1].due_s)
                pause_s = wanted.due_s - time.monotonic()
                if pause_s <= 0:
                    del self._waiting[who]
            if pause_s > 0:
                self._closed.wait(pause_s)
            else:
                self._prepare(wanted, who)

    def _is_wanted(self, wanted: _Wanted, who: str) -> bool:
        """False once the operator is somewhere else."""
        with self._lock:
            newer = self._waiting.get(who, wanted)
        return newer.key == wanted.key and not self._closed.is_set()

    def _prepare(self, wanted: _Wanted, who: str) -> None:
        """What will be asked for next: about this frame, the next one and the one before."""
        project, found = wanted.project, self._known(wanted.key)
        if found is None or found.is_prepared:
            return
        # once, also where something beside it is broken
        found.is_prepared = True
        try:
            _ = found.jpeg, found.index, found.with_normals
            before, following = neighbours(project, wanted.stored)
            for beside in (following, before):
                if not self._is_wanted(wanted, who):
                    found.is_prepared = False
                    return
                if beside is not None and self._known((project, beside)) is None:
                    self._make_ready(project, beside)
        except AnnotatorError as error:
            # whoever opens the frame is told what is wrong with it
            LOG.debug("frames beside %s: %s", wanted.stored.key, error)
        except Exception:
            LOG.exception("reading ahead of frame %s failed", wanted.stored.key)

    def _make_ready(self, project: Project, frame_id: int) -> None:
        ready = self._open(project, project.frames.get(frame_id))
        _ = ready.jpeg, ready.index
        for label in project.labels.of_frame(frame_id):
            ready.points_in(label.box)
