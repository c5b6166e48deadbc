"""The pictures of contact sheets: drawn ahead, those of the selected track first, and kept."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict, defaultdict, deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from annotator.project import Project, StoredFrame
from annotator.project.boxes import png
from annotator.types import Frame, Label, OrientedBox, ReviewState
from annotator.types.errors import AnnotatorError, FrameError
from annotator.workflows.workbench.contact_sheet import picture
from annotator.workflows.workbench.frame_cache import FrameCache

LOG = logging.getLogger("annotator.web")

# A picture takes some 15 kB.
MOST_PICTURES = 4000
# Pause after each frame that is drawn ahead, so that requests go first, seconds.
PAUSE_S = 0.05


Key = tuple[object, ...]


class SheetPictures:
    """Draws and keeps pictures of boxes. Thread-safe."""

    def __init__(self, frames: FrameCache, most: int = MOST_PICTURES) -> None:
        self._frames, self._most = frames, most
        self._lock = threading.Lock()
        self._pictures: OrderedDict[Key, bytes] = OrderedDict()
        self._being_drawn: dict[Key, Future[bytes]] = {}
        self._executor = ThreadPoolExecutor(1, "sheets")
        self._drawing: set[tuple[Project, int]] = set()
        # boxes to draw before the others of their recording
        self._first: dict[tuple[Project, int], deque[tuple[StoredFrame, list[Label]]]] = {}
        self._closed = threading.Event()

    def close(self) -> None:
        """Stops drawing ahead."""
        self._closed.set()
        self._executor.shutdown(wait=False, cancel_futures=True)

    def get(self, project: Project, stored: StoredFrame, box: OrientedBox, frame: Frame | None = None) -> bytes:
        """The picture of a box as a PNG file; drawn once, even if several threads ask for it.

        Args:
            frame: the frame, if it is read already.

        Raises:
            FrameError, RecordingError: the frame cannot be read.
        """
        key = self._key(project, stored, box)
        with self._lock:
            known, drawn_by_other = self._known(key), self._being_drawn.get(key)
            mine: Future[bytes] = Future()
            if known is None and drawn_by_other is None:
                self._being_drawn[key] = mine
        if known is not None:
            return known
        if drawn_by_other is not None:
            return drawn_by_other.result()
        try:
            content = png(picture(self._frames.look(project, stored) if frame is None else frame, box))
            mine.set_result(content)
        except BaseException as error:
            mine.set_exception(error)
            raise
        finally:
            with self._lock:
                del self._being_drawn[key]
        with self._lock:
            self._pictures[key] = content
            while len(self._pictures) > self._most:
                self._pictures.popitem(last=False)
        return content

    def prepare(self, project: Project, recording_id: int, track: Sequence[tuple[StoredFrame, Label]] = ()) -> None:
        """Draws pictures in the background: those of a track first, then of a recording's open proposals."""
        job = project, recording_id
        with self._lock:
            self._first[job] = deque((stored, [label]) for stored, label in track if stored.index is not None)
            if job in self._drawing or self._closed.is_set():
                return
            self._drawing.add(job)
        self._executor.submit(self._prepare, project, recording_id)

    def _prepare(self, project: Project, recording_id: int) -> None:
        job = project, recording_id
        try:
            rest = self._open_proposals(project, recording_id)
            while not self._closed.is_set():
                with self._lock:
                    waiting = self._first[job] or rest
                    if not waiting:
                        break
                    stored, labels = waiting.popleft()
                self._prepare_frame(project, stored, labels)
        except AnnotatorError as error:
            LOG.info("the contact sheets were not drawn ahead: %s", error)
        finally:
            with self._lock:
                self._drawing.discard(job)
                self._first.pop(job, None)

    def _open_proposals(self, project: Project, recording_id: int) -> deque[tuple[StoredFrame, list[Label]]]:
        """The open proposals of a recording, frame by frame, as many as are kept."""
        by_frame: dict[int, list[Label]] = defaultdict(list)
        for each in project.labels.select(states=[ReviewState.PROPOSED], recordings=[recording_id]):
            by_frame[each.frame_id].append(each.label)
        chosen: deque[tuple[StoredFrame, list[Label]]] = deque()
        left = self._most
        for stored in project.frames.of([recording_id]):
            left -= len(by_frame[stored.id])
            if left < 0:
                break
            if stored.index is not None and by_frame[stored.id]:
                chosen.append((stored, by_frame[stored.id]))
        return chosen

    def _prepare_frame(self, project: Project, stored: StoredFrame, labels: list[Label]) -> None:
        keys = [self._key(project, stored, label.box) for label in labels]
        with self._lock:
            missing = [
                label
                for key, label in zip(keys, labels, strict=True)
                if self._known(key) is None and key not in self._being_drawn
            ]
        if not missing:
            return
        try:
            frame = self._frames.look(project, stored)
        except FrameError as error:  # shown when the frame is opened
            LOG.info("%s", error)
            return
        for label in missing:
            self.get(project, stored, label.box, frame)
        self._closed.wait(PAUSE_S)

    def _known(self, key: Key) -> bytes | None:
        """Must be called with the lock."""
        if key in self._pictures:
            self._pictures.move_to_end(key)
        return self._pictures.get(key)

    @staticmethod
    def _key(project: Project, stored: StoredFrame, box: OrientedBox) -> Key:
        pose = box.pose.tobytes()
        adjusted = project.adjustments.newest(stored.recording_id)
        # not its path: another project can take its place
        return project, stored.id, stored.key, adjusted, pose, box.size_m.tobytes()
