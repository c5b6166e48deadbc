"""An open frame with its cached results: JPEG, normals, views, their pictures, and detections."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Any, Generic, TypeVar

import numpy as np
from jaxtyping import Bool, Int64

from annotator.geometry.normals import normals_from_depth
from annotator.geometry.oriented_box import contains
from annotator.geometry.projection import in_frustum
from annotator.project.overview import FramePage
from annotator.project.views import png
from annotator.types import Box2D, Detector, Frame, OrientedBox, PseudoView
from annotator.types.errors import AnnotatorError

JPEG_QUALITY = 92
# Cached frustums, views, pictures and found boxes of one frame: enough to go back and forth between a few objects.
MAX_RESULTS = 80

# Position, color, pixel and normal of a point.
BYTES_A_POINT = 12 + 3 + 4 + 12

T = TypeVar("T")
Views = tuple[PseudoView, PseudoView]


class _Once(Generic[T]):
    """A result that one thread computes while others wait for it.

    `functools.cached_property` shares one lock between all objects before Python 3.12, so frames waited for each other.
    """

    def __init__(self, compute: Callable[[], T]) -> None:
        self._compute = compute
        self._lock = threading.Lock()
        self._results: list[T] = []

    def get(self) -> T:
        """Returns the result; an error is raised to each caller, and the next one tries again."""
        if not self._results:
            with self._lock:
                if not self._results:
                    self._results.append(self._compute())
        return self._results[0]


class OpenFrame:
    """An open frame. Thread-safe.

    Attributes:
        frame: the frame.
        adjusted: id of the event that adjusted its recording last, when the frame was read; 0 = none.
        is_prepared: its results were computed ahead, and its neighbours read ahead.
        page: the stored state as read last; None before the first read.
    """

    def __init__(self, frame: Frame, adjusted: int = 0) -> None:
        self.frame = frame
        self.adjusted = adjusted
        self.is_prepared = False
        self.page: FramePage | None = None
        self._jpeg = _Once(lambda: _jpeg(frame))
        self._with_normals = _Once(lambda: _with_normals(frame))
        self._counts: dict[bytes, int] = {}
        self._lock = threading.Lock()
        self._results: OrderedDict[Hashable, Any] = OrderedDict()
        self._newest: dict[str, tuple[int, Any]] = {}

    @property
    def memory_bytes(self) -> int:
        """Memory that the frame takes with its normals, roughly."""
        frame = self.frame
        depth_bytes = 0 if frame.depth_m is None else frame.depth_m.nbytes
        return frame.rgb.nbytes + depth_bytes + BYTES_A_POINT * len(frame.cloud)

    @property
    def jpeg(self) -> bytes:
        """The image as a JPEG file."""
        return self._jpeg.get()

    @property
    def with_normals(self) -> Frame:
        """The frame with normals from its depth image; unchanged if it has normals already or no depth image."""
        return self._with_normals.get()

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

    def frustum(self, box: Box2D) -> Bool[np.ndarray, "n"]:
        """Returns the mask of the points inside the frustum of a box on the image."""
        mask: np.ndarray = self.once(
            ("frustum", box.xyxy), lambda: in_frustum(self.frame.camera, self.frame.cloud.xyz_m, box)
        )
        return mask

    def views(self, key: Hashable, draw: Callable[[Frame], Views | None]) -> Views | None:
        """Returns the views of a step, drawn once per `key`, which must hold all that they depend on."""
        views: Views | None = self.once(("views", key), lambda: draw(self.with_normals))
        return views

    def picture(self, view: PseudoView) -> bytes:
        """Returns the PNG file of a view from `views`; encoded once."""
        # the result holds the view, so that no other view gets its id
        content: bytes = self.once(("picture", id(view)), lambda: (view, png(view.rgb)))[1]
        return content

    def image_detections(self, detector: Detector) -> list[Box2D]:
        """Returns a detector's boxes on the image; detected once."""
        boxes: list[Box2D] = self.once(("image", detector.fingerprint), lambda: detector.detect([self.frame])[0])
        return boxes

    def newest(self, name: str, revision: int, compute: Callable[[], T]) -> T:
        """Returns a result that depends on the revision of the frame's labels; only the newest is kept."""
        cached = self._newest.get(name)
        if cached is None or cached[0] != revision:
            cached = self._newest[name] = (revision, compute())
        result: T = cached[1]
        return result

    def latest(self, name: str) -> Any:
        """Returns the result of the last call of `newest`, of any revision; None if there was none."""
        return self._newest.get(name, (0, None))[1]

    def once(self, key: Hashable, compute: Callable[[], T]) -> T:
        """Returns a result that depends on nothing but the frame and `key`; the latest results are kept."""
        with self._lock:
            if key in self._results:
                self._results.move_to_end(key)
                known: T = self._results[key]
                return known
        # without the lock: two threads may compute the same result, and the later one is kept
        result = compute()
        with self._lock:
            self._results[key] = result
            while len(self._results) > MAX_RESULTS:
                self._results.popitem(last=False)
        return result


def _jpeg(frame: Frame) -> bytes:
    import cv2

    bgr = np.ascontiguousarray(frame.rgb[..., ::-1])
    written, content = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not written:
        raise AnnotatorError(f"frame {frame.key}: the image cannot be written as JPEG")
    return content.tobytes()


def _with_normals(frame: Frame) -> Frame:
    cloud = frame.cloud
    if cloud.normals is not None or frame.depth_m is None or cloud.pixel_index is None:
        return frame
    grid = normals_from_depth(frame.camera, frame.depth_m).reshape(-1, 3)
    return replace(frame, cloud=replace(cloud, normals=grid[cloud.pixel_index]))
