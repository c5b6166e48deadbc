"""A frame that somebody looks at, with what is computed from it once."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool

from annotator.geometry.frustum import in_frustum
from annotator.geometry.normals import normals_from_depth
from annotator.geometry.point_index import PointIndex
from annotator.project.overview import FramePage
from annotator.types import Box2D, Detector, Frame, OrientedBox, PseudoView
from annotator.types.errors import AnnotatorError

JPEG_QUALITY = 92
# Steps of objects that are kept: an operator goes back and forth between a few.
STEPS_KEPT = 40

T = TypeVar("T")
Views = tuple[PseudoView, PseudoView]


class OpenFrame:
    """A frame that is looked at; threads share it.

    Attributes:
        frame: the frame.
        is_prepared: what is computed once has been asked for, and the next frame too.
        page: what was read of it last, where it was.
    """

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        self.is_prepared = False
        self.page: FramePage | None = None
        self._counts: dict[bytes, int] = {}
        self._lock = threading.Lock()
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()
        self._newest: dict[str, tuple[int, Any]] = {}

    @cached_property
    def jpeg(self) -> bytes:
        """The image as a JPEG file."""
        import cv2

        bgr = np.ascontiguousarray(self.frame.rgb[..., ::-1])
        written, content = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if not written:
            raise AnnotatorError(f"frame {self.frame.key}: the image cannot be written as JPEG")
        return content.tobytes()

    @cached_property
    def index(self) -> PointIndex:
        """The cloud, sorted for looks into single boxes."""
        return PointIndex.of(self.frame.cloud.xyz_m)

    @cached_property
    def with_normals(self) -> Frame:
        """The frame with normals where a depth image gives them all at once; else as it is."""
        frame, cloud = self.frame, self.frame.cloud
        if cloud.normals is not None or frame.depth_m is None or cloud.pixel_index is None:
            return frame
        grid = normals_from_depth(frame.camera, frame.depth_m).reshape(-1, 3)
        return replace(frame, cloud=replace(cloud, normals=grid[cloud.pixel_index]))

    def points_in(self, box: OrientedBox) -> int:
        """How many points lie in a box; counted once for each box that a label has had."""
        key = box.T_camera_box.as_matrix().tobytes() + box.size_m.tobytes()
        found = self._counts.get(key)
        if found is None:
            found = self._counts[key] = self.index.count(box)
        return found

    def frustum(self, box: Box2D) -> Bool[np.ndarray, "n"]:
        """Which points appear in a box on the image."""
        mask: np.ndarray = self._once(
            ("frustum", box.xyxy), lambda: in_frustum(self.frame.camera, self.frame.cloud.xyz_m, box)
        )
        return mask

    def views(self, key: Hashable, draw: Callable[[Frame], Views | None]) -> Views | None:
        """The views of a step, drawn once for each `key`, which must tell all that decides about them."""
        found: Views | None = self._once(("views", key), lambda: draw(self.with_normals))
        return found

    def detections(self, views: Views, detector: Detector) -> list[list[Box2D]]:
        """What a detector finds on the views of a step, asked once."""
        found: list[list[Box2D]] = self._once(
            ("found", id(views[0]), detector.fingerprint), lambda: (views, detector.detect(views))
        )[1]
        return found

    def image_detections(self, detector: Detector) -> list[Box2D]:
        """What a detector finds on the image, asked once."""
        found: list[Box2D] = self._once(("image", detector.fingerprint), lambda: detector.detect([self.frame])[0])
        return found

    def newest(self, name: str, revision: int, make: Callable[[], T]) -> T:
        """What follows from one revision of the frame's labels, made once; only the last one asked for is kept."""
        known = self._newest.get(name)
        if known is None or known[0] != revision:
            known = self._newest[name] = (revision, make())
        found: T = known[1]
        return found

    def _once(self, key: Hashable, make: Callable[[], Any]) -> Any:
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        # two threads that ask at once both make it, and one of the two is kept
        made = make()
        with self._lock:
            self._kept[key] = made
            while len(self._kept) > STEPS_KEPT:
                self._kept.popitem(last=False)
        return made
