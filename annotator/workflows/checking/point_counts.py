"""Counts the points in the boxes of a project's labels; cached on disk, because reading frames is slow."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Sequence

import numpy as np
from pydantic import RootModel, ValidationError

from annotator.files import TABLE_BYTES, read_file, write_atomic
from annotator.geometry.oriented_box import contains
from annotator.project import Project, StoredFrame
from annotator.types import OrientedBox
from annotator.types.errors import FrameError, RecordingError
from annotator.workflows.frame_source import FrameSource

# Folder within the project for data that can be recomputed.
CACHE_FOLDER = "cache"
CACHE_FILE = "points_inside.json"

_LOCK = threading.Lock()


class _CachedCounts(RootModel[dict[str, int]]):
    """The number of points by frame and box."""


class PointCounts:
    """Counts points, with a cache on disk.

    Attributes:
        unreadable: frames that could not be read, as `key: reason`.
        unknown: number of frames left out because the time budget was used up.
    """

    def __init__(self, project: Project, budget_s: float | None = None) -> None:
        """
        Args:
            budget_s: time for reading frames, seconds; None = no limit.
        """
        self._project = project
        self._source = FrameSource(project)
        self._budget_s = budget_s
        self._spent_s = 0.0
        self._path = project.path / CACHE_FOLDER / CACHE_FILE
        self._cached = self._load()
        self._new: dict[str, int] = {}
        self.unreadable: list[str] = []
        self.unknown = 0

    def __call__(self, frame: StoredFrame, boxes: Sequence[OrientedBox]) -> list[int] | None:
        """Returns the number of points of a frame in each box; None if it cannot be read or the time is used up."""
        keys = [_key(frame, box) for box in boxes]
        if any(key not in self._cached for key in keys):
            if self._budget_s is not None and self._spent_s >= self._budget_s:
                self.unknown += 1
                return None
            if not self._count(frame, dict(zip(keys, boxes, strict=True))):
                return None
        return [self._cached[key] for key in keys]

    def save(self) -> None:
        """Saves the new counts. A cache that cannot be written is ignored: points are then counted again."""
        if not self._new:
            return
        with _LOCK:
            merged = self._load() | self._new
            try:
                self._path.parent.mkdir(exist_ok=True)
                write_atomic(self._path, _CachedCounts(merged).model_dump_json().encode())
            except OSError:
                return
        self._new = {}

    def _count(self, frame: StoredFrame, boxes: dict[str, OrientedBox]) -> bool:
        begin = time.perf_counter()
        try:
            xyz_m = self._source.read(frame).cloud.xyz_m
        except (FrameError, RecordingError) as error:
            self.unreadable.append(f"{frame.key}: {error}")
            return False
        finally:
            self._spent_s += time.perf_counter() - begin
        counts = {key: int(np.count_nonzero(contains(box, xyz_m))) for key, box in boxes.items()}
        self._cached |= counts
        self._new |= counts
        return True

    def _load(self) -> dict[str, int]:
        try:
            return _CachedCounts.model_validate_json(read_file(self._path, TABLE_BYTES)).root
        except (OSError, ValidationError):
            # missing or damaged: counted again
            return {}


def _key(frame: StoredFrame, box: OrientedBox) -> str:
    content = box.pose.tobytes() + box.size_m.tobytes()
    return f"{frame.id}:{hashlib.sha256(content).hexdigest()[:16]}"
