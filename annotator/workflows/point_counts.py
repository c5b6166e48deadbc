"""How many points lie in the boxes of a project's labels, kept between looks: reading frames is slow."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Sequence

from pydantic import RootModel, ValidationError

from annotator.files import write_atomic
from annotator.geometry.point_index import PointIndex
from annotator.project import Project, StoredFrame
from annotator.types import OrientedBox
from annotator.types.errors import FrameError, RecordingError
from annotator.workflows.frames import FrameSource

# within the project: for what can be made again
CACHE_FOLDER = "cache"
CACHE_FILE = "points_inside.json"

_LOCK = threading.Lock()


class _Kept(RootModel[dict[str, int]]):
    """By frame and box, how many points."""


class PointCounts:
    """Counts points; what was counted before is not counted again, also by the next program.

    Attributes:
        unreadable: frames that could not be read, as `key: reason`.
        unknown: how many frames were left out because the time was up.
    """

    def __init__(self, project: Project, budget_s: float | None = None) -> None:
        """
        Args:
            budget_s: once so many seconds have gone into reading frames, no more are read; None = no limit.
        """
        self._project = project
        self._source = FrameSource(project)
        self._budget_s = budget_s
        self._spent_s = 0.0
        self._path = project.path / CACHE_FOLDER / CACHE_FILE
        self._kept = self._load()
        self._new: dict[str, int] = {}
        self.unreadable: list[str] = []
        self.unknown = 0

    def __call__(self, frame: StoredFrame, boxes: Sequence[OrientedBox]) -> list[int] | None:
        """How many points of a frame lie in each box; None where it cannot be read, or the time is up."""
        keys = [_key(frame, box) for box in boxes]
        if any(key not in self._kept for key in keys):
            if self._budget_s is not None and self._spent_s >= self._budget_s:
                self.unknown += 1
                return None
            if not self._count(frame, dict(zip(keys, boxes, strict=True))):
                return None
        return [self._kept[key] for key in keys]

    def save(self) -> None:
        """Keeps what was counted. A cache that cannot be written is no fault: it is counted again."""
        if not self._new:
            return
        with _LOCK:
            merged = self._load() | self._new
            try:
                self._path.parent.mkdir(exist_ok=True)
                write_atomic(self._path, _Kept(merged).model_dump_json().encode())
            except OSError:
                return
        self._new = {}

    def _count(self, frame: StoredFrame, boxes: dict[str, OrientedBox]) -> bool:
        begin = time.perf_counter()
        try:
            index = PointIndex.of(self._source.read(frame).cloud.xyz_m)
        except (FrameError, RecordingError) as error:
            self.unreadable.append(f"{frame.key}: {error}")
            return False
        finally:
            self._spent_s += time.perf_counter() - begin
        found = {key: index.count(box) for key, box in boxes.items()}
        self._kept |= found
        self._new |= found
        return True

    def _load(self) -> dict[str, int]:
        try:
            return _Kept.model_validate_json(self._path.read_bytes()).root
        except (OSError, ValidationError):
            # none yet, or a damaged one: a cache may be made again
            return {}


def _key(frame: StoredFrame, box: OrientedBox) -> str:
    content = box.T_camera_box.as_matrix().tobytes() + box.size_m.tobytes()
    return f"{frame.id}:{hashlib.sha256(content).hexdigest()[:16]}"
