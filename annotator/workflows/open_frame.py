"""A frame that somebody looks at, with what is computed from it once."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from annotator.geometry.point_index import PointIndex
from annotator.types import Frame, OrientedBox
from annotator.types.errors import AnnotatorError

JPEG_QUALITY = 92


class OpenFrame:
    """A frame that is looked at; threads share it.

    Attributes:
        frame: the frame.
    """

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        self._counts: dict[bytes, int] = {}

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

    def points_in(self, box: OrientedBox) -> int:
        """How many points lie in a box; counted once for each box that a label has had."""
        key = box.T_camera_box.as_matrix().tobytes() + box.size_m.tobytes()
        found = self._counts.get(key)
        if found is None:
            found = self._counts[key] = self.index.count(box)
        return found
