"""Open frames with their cached results, kept in a cache that reads the neighbours of the frame on screen ahead."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Int64, UInt8

from annotator.geometry.ground import Ground, find_ground
from annotator.geometry.normals import normals_from_depth
from annotator.geometry.oriented_box import contains
from annotator.geometry.transforms import IMAGE_UP
from annotator.image_bytes import encoded_image
from annotator.project import Project, StoredFrame
from annotator.project.overview import neighbours
from annotator.recordings import Recording
from annotator.types import Camera, Frame, OrientedBox, PseudoView
from annotator.types.errors import AnnotatorError, FrameError
from annotator.workflows.frame_source import FrameSource

JPEG_QUALITY = 92
# Cached frustums, views, pictures and found boxes of one frame: enough to go back and forth between a few objects.
MAX_RESULTS = 80

# Position, color, pixel and normal of a point.
BYTES_A_POINT = 12 + 3 + 4 + 12

T = TypeVar("T")
Views = tuple[PseudoView, PseudoView]


class Memo:
    """Keeps the latest results. Each is computed by one thread, while others wait for it. Thread-safe."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._lock = threading.Lock()
        self._results: OrderedDict[Hashable, tuple[threading.Lock, list[Any]]] = OrderedDict()

    def get(self, key: Hashable, compute: Callable[[], T]) -> T:
        """Returns a result; an error is raised to each caller, and the next one tries again."""
        with self._lock:
            lock, result = self._results.setdefault(key, (threading.Lock(), []))
            self._results.move_to_end(key)
            while len(self._results) > self._most:
                self._results.popitem(last=False)
        with lock:
            if not result:
                result.append(compute())
        found: T = result[0]
        return found

    def known(self, key: Hashable) -> Any:
        """Returns a result that was computed; None if there is none."""
        with self._lock:
            _, result = self._results.get(key, (None, ()))
        return result[0] if result else None


class OpenFrame:
    """An open frame. Thread-safe.

    Attributes:
        adjusted: id of the event that adjusted its recording last, when the frame was read; 0 = none.
    """

    def __init__(self, frame: Frame, adjusted: int = 0) -> None:
        self.frame = frame
        self.adjusted = adjusted
        self._whole, self._results = Memo(3), Memo(MAX_RESULTS)
        self._counts: dict[bytes, int] = {}

    @property
    def memory_bytes(self) -> int:
        """Memory that the frame takes with its normals, roughly."""
        frame = self.frame
        depth_bytes = 0 if frame.depth_m is None else frame.depth_m.nbytes
        return frame.rgb.nbytes + depth_bytes + BYTES_A_POINT * len(frame.cloud)

    @property
    def jpeg(self) -> bytes:
        """The image as a JPEG file."""
        return self._whole.get("jpeg", lambda: encoded_image(self.frame.rgb, "jpg", JPEG_QUALITY))

    @property
    def with_normals(self) -> Frame:
        """The frame with normals from its depth image; unchanged if it has normals already or no depth image."""
        return self._whole.get("normals", lambda: _with_normals(self.frame))

    @property
    def ground(self) -> Ground:
        """The ground below its points."""
        up = IMAGE_UP if self.frame.up is None else self.frame.up
        return self._whole.get("ground", lambda: find_ground(self.frame.cloud.xyz_m, up))

    def inside(self, box: OrientedBox) -> Int64[np.ndarray, "m"]:
        """Returns the indices of the points in a box."""
        return np.flatnonzero(contains(box, self.frame.cloud.xyz_m))

    def points_in(self, box: OrientedBox) -> int:
        """Returns the number of points in a box; counted once for each box."""
        key = box.pose.tobytes() + box.size_m.tobytes()
        count = self._counts.get(key)
        if count is None:
            count = self._counts[key] = int(np.count_nonzero(contains(box, self.frame.cloud.xyz_m)))
        return count

    def views(self, key: Hashable, draw: Callable[[Frame], Views | None]) -> Views | None:
        """Returns the views of a step, drawn once per `key`, which must hold all that they depend on."""
        return self.once(("views", key), lambda: draw(self.with_normals))

    def picture(self, view: PseudoView) -> bytes:
        """Returns the PNG file of a view from `views`; encoded once."""
        # the result holds the view, so that no other view gets its id
        return self.once(("picture", id(view)), lambda: (view, encoded_image(view.rgb)))[1]

    def once(self, key: Hashable, compute: Callable[[], T]) -> T:
        """Returns a result that depends on nothing but the frame and `key`; the latest results are kept."""
        return self._results.get(key, compute)


def _small(rgb: UInt8[np.ndarray, "h w 3"], width_px: int) -> bytes:
    import cv2

    if width_px < rgb.shape[1]:
        height_px = max(round(rgb.shape[0] * width_px / rgb.shape[1]), 1)
        rgb = cv2.resize(rgb, (width_px, height_px), interpolation=cv2.INTER_AREA)
    return encoded_image(rgb, "jpg", JPEG_QUALITY)


def _with_normals(frame: Frame) -> Frame:
    cloud = frame.cloud
    if cloud.normals is not None or frame.depth_m is None or cloud.pixel_index is None:
        return frame
    grid = normals_from_depth(frame.camera, frame.depth_m).reshape(-1, 3)
    return replace(frame, cloud=replace(cloud, normals=grid[cloud.pixel_index]))


LOG = logging.getLogger("annotator.web")

# Frames that are always kept: the current, the previous and the next one of a few operators.
KEPT_FRAMES = 8
# Others are kept within this memory. Ten operators on twenty frames otherwise wait for each other's reading.
KEPT_BYTES = 512 * 2**20
# Small pictures of frames; one takes some 3 kB.
MOST_SMALL = 4000
# Cameras of recordings.
MOST_CAMERAS = 1000
# Delay before reading ahead, so that the requests of the current frame go first, seconds.
PAUSE_S = 0.4


class FrameCache:
    """Caches the most recently used frames and reads the neighbours of open frames ahead. Thread-safe."""

    def __init__(self, kept_frames: int = KEPT_FRAMES, kept_bytes: int = KEPT_BYTES) -> None:
        self._kept_frames, self._kept_bytes = kept_frames, kept_bytes
        self._lock = threading.Lock()
        self._frames: OrderedDict[tuple[Project, int], OpenFrame] = OrderedDict()
        self._sources: dict[Project, tuple[threading.Lock, FrameSource]] = {}
        self._executor = ThreadPoolExecutor(1, "read-ahead")
        # the frame that each operator has opened last
        self._open_by: dict[str, tuple[Project, int]] = {}
        self._closed = threading.Event()
        self._small = Memo(MOST_SMALL)
        self._cameras = Memo(MOST_CAMERAS)

    def read(self, project: Project, frame_id: int) -> Frame:
        """Returns a frame.

        Raises:
            NotFoundError: no such frame.
            FrameError, RecordingError: it cannot be read.
        """
        return self.open(project, frame_id).frame

    def open(self, project: Project, frame_id: int, operator: str | None = "") -> OpenFrame:
        """Returns a frame with its cached results, and schedules reading ahead. Raises as `read`.

        Args:
            operator: who opens it; what was to be read ahead for the operator's former frame is left out. None = nobody
                does, and nothing is read ahead.
        """
        stored = project.frames.get(frame_id)
        opened = self._open(project, stored)
        if operator is not None and self._open_by.get(operator) != (project, frame_id):
            self._open_by[operator] = project, frame_id
            # the executor refuses jobs after `close`
            with suppress(RuntimeError):
                self._executor.submit(self._prepare, project, stored, operator)
        return opened

    def look(self, project: Project, stored: StoredFrame) -> Frame:
        """Returns a frame that is not opened: it is not cached, and nothing is read ahead. Raises as `read`."""
        opened = self._cached((project, stored.id))
        if opened is not None and opened.adjusted == project.adjustments.newest(stored.recording_id):
            return opened.frame
        lock, source = self._source(project)
        with lock:
            opened_recording = source.adjusted(stored.recording_id)
            if not opened_recording.recording.is_parallel:
                return self._read(project, source, stored)
        # without the lock: threads that draw many frames read them side by side, and no frame is opened later
        try:
            return opened_recording.read(stored.key)
        except FrameError:
            with lock:
                return self._read(project, source, stored)

    def small(self, project: Project, frame_id: int, width_px: int) -> bytes:
        """Returns a small picture of a frame as a JPEG file, read once; the frame is not opened. Raises as `read`."""
        stored = project.frames.get(frame_id)
        key = project, frame_id, stored.key, project.adjustments.newest(stored.recording_id), width_px
        return self._small.get(key, lambda: _small(self._image(project, stored), width_px))

    def _image(self, project: Project, stored: StoredFrame) -> UInt8[np.ndarray, "h w 3"]:
        """The image of a frame, without its points where the recording can do that."""
        if self._cached((project, stored.id)) is None:
            lock, source = self._source(project)
            with lock:
                recording = source.adjusted(stored.recording_id)
            with nullcontext() if recording.recording.is_parallel else lock, suppress(FrameError):
                return recording.image(stored.key)
        return self.look(project, stored).rgb

    def camera(self, project: Project, frame_id: int) -> Camera:
        """Returns the camera of a frame's recording; the first frame that is asked for is read. Raises as `read`."""
        stored = project.frames.get(frame_id)
        key = project, stored.recording_id, project.adjustments.newest(stored.recording_id)
        return self._cameras.get(key, lambda: self.look(project, stored).camera)

    def recorded(self, project: Project, frame_id: int) -> Frame:
        """Returns a frame as its recording's files give it; it is not cached. Raises as `read`."""
        stored = project.frames.get(frame_id)
        lock, source = self._source(project)
        with lock:
            return source.recorded(stored)

    def recording(self, project: Project, recording_id: int) -> Recording:
        """Returns an open recording.

        Raises:
            RecordingError: it is missing or cannot be read.
        """
        lock, source = self._source(project)
        with lock:
            return source.recording(recording_id)

    def forget(self, project: Project) -> None:
        """Drops all frames of a project, e.g. after its recordings have changed."""
        with self._lock:
            self._sources.pop(project, None)
            self._small, self._cameras = Memo(MOST_SMALL), Memo(MOST_CAMERAS)
            self._open_by = {who: key for who, key in self._open_by.items() if key[0] is not project}
            for key in [key for key in self._frames if key[0] is project]:
                del self._frames[key]

    def close(self) -> None:
        """Stops reading ahead."""
        self._closed.set()
        self._executor.shutdown(wait=False, cancel_futures=True)

    def _cached(self, key: tuple[Project, int]) -> OpenFrame | None:
        with self._lock:
            if key in self._frames:
                self._frames.move_to_end(key)
            return self._frames.get(key)

    def _open(self, project: Project, stored: StoredFrame) -> OpenFrame:
        key, adjusted = (project, stored.id), project.adjustments.newest(stored.recording_id)
        opened = self._cached(key)
        if opened is not None and opened.adjusted == adjusted:
            return opened
        lock, source = self._source(project)
        # one frame of a project at a time: a thread that waited here may find its frame in the cache
        with lock:
            opened = self._cached(key)
            if opened is not None and opened.adjusted == adjusted:
                return opened
            opened = OpenFrame(self._read(project, source, stored), adjusted)
            # stored before the lock is released, so that the next thread does not read the frame again
            with self._lock:
                self._frames[key] = opened
                total = sum(each.memory_bytes for each in self._frames.values())
                while len(self._frames) > self._kept_frames and total > self._kept_bytes:
                    total -= self._frames.popitem(last=False)[1].memory_bytes
        return opened

    def _read(self, project: Project, source: FrameSource, stored: StoredFrame) -> Frame:
        try:
            return source.read(stored)
        except FrameError:
            # the recording may have grown since it was opened, so it is opened again; a broken frame fails again
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

    def _prepare(self, project: Project, stored: StoredFrame, operator: str) -> None:
        """Computes the results the page asks for next: of this frame, then of the next and the previous one."""

        def is_left() -> bool:
            return self._closed.is_set() or self._open_by.get(operator) != (project, stored.id)

        if is_left() or self._closed.wait(PAUSE_S) or is_left():
            return
        try:
            opened = self._open(project, stored)
            _ = opened.jpeg, opened.with_normals
            previous_id, next_id = neighbours(project, stored)
            for neighbour_id in (next_id, previous_id):
                if is_left():
                    return
                if neighbour_id is not None and self._cached((project, neighbour_id)) is None:
                    self._prepare_neighbour(project, neighbour_id)
        except AnnotatorError as error:
            # the error is shown when the frame itself is opened
            LOG.debug("neighbours of frame %s: %s", stored.key, error)
        except Exception:
            LOG.exception("reading the neighbours of frame %s ahead failed", stored.key)

    def _prepare_neighbour(self, project: Project, frame_id: int) -> None:
        opened = self._open(project, project.frames.get(frame_id))
        _ = opened.jpeg, opened.ground
        for label in project.labels.of_frame(frame_id):
            opened.points_in(label.box)
