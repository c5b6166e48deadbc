"""The frames that are looked at now, kept ready: image, cloud, and what is computed from them once."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

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


class FrameCache:
    """Reads frames once and keeps the last few; the ones beside each are read ahead. Threads share it."""

    def __init__(self, kept: int = FRAMES_KEPT) -> None:
        self._kept = kept
        self._lock = threading.Lock()
        self._frames: OrderedDict[tuple[Project, int], OpenFrame] = OrderedDict()
        self._sources: dict[Project, tuple[threading.Lock, FrameSource]] = {}
        self._ahead = ThreadPoolExecutor(1, "read-ahead")
        self._newest: OpenFrame | None = None
        self._closed = threading.Event()

    def read(self, project: Project, frame_id: int) -> Frame:
        """A frame.

        Raises:
            NotFoundError: no such frame.
            FrameError, RecordingError: it cannot be read.
        """
        return self.open(project, frame_id).frame

    def open(self, project: Project, frame_id: int) -> OpenFrame:
        """A frame with what is computed from it; as `read`."""
        stored = project.frames.get(frame_id)
        found = self._open(project, stored)
        self._read_ahead(project, stored, found)
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

    def _read_ahead(self, project: Project, stored: StoredFrame, found: OpenFrame) -> None:
        self._newest = found
        if found.is_prepared:
            return
        found.is_prepared = True
        # after `close` nothing is read ahead any more
        with suppress(RuntimeError):
            self._ahead.submit(self._prepare, project, stored, found)

    def _prepare(self, project: Project, stored: StoredFrame, found: OpenFrame) -> None:
        """What will be asked for next: about this frame, the next one and the one before."""
        if self._closed.wait(PAUSE_S):
            return
        if self._newest is not found:
            # the operator is somewhere else already
            found.is_prepared = False
            return
        try:
            _ = found.jpeg, found.index, found.with_normals
            before, following = neighbours(project, stored)
            for beside in (following, before):
                if beside is not None and self._newest is found and self._known((project, beside)) is None:
                    self._make_ready(project, beside)
        except AnnotatorError as error:
            # whoever opens the frame is told what is wrong with it
            LOG.debug("frames beside %s: %s", stored.key, error)
        except Exception:
            LOG.exception("reading ahead of frame %s failed", stored.key)

    def _make_ready(self, project: Project, frame_id: int) -> None:
        ready = self._open(project, project.frames.get(frame_id))
        _ = ready.jpeg, ready.index
        for label in project.labels.of_frame(frame_id):
            ready.points_in(label.box)
