"""What the simulated operator of Review sees and waits for: the project, its open frame, and the pictures of boxes."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import contains
from annotator.geometry.outline import box_on_image
from annotator.image_bytes import encoded_image
from annotator.project import Effort, Project, StoredFrame, WriteContext
from annotator.project.changes import Payload
from annotator.types import Label, OrientedBox, ReviewState
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.simulate import MIN_VISIBLE_POINTS
from annotator.workflows.workbench.contact_sheet import ortho_views
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.save_object import apply_changes
from benchmarks.review_moves import VIEW_PX, Bill

AUTHOR = "simulated operator"

T = TypeVar("T")
TrackKey = tuple[str, int]


@dataclass(frozen=True, eq=False)
class Thing:
    """A true object in a frame. It is `due` if it is visible, so that it must get a box."""

    key: TrackKey
    """Class and track id; of objects without a track, one track for each class."""
    label: str
    box: OrientedBox
    due: bool


class Desk:
    """A project in review.

    Attributes:
        frames: to review, in time order.
        quality: 3D IoU from which a box is right.
        bills: the effort by track; None: looks at frames, and proposals of no object.
        waits: seconds that each kind of work took the last time.
        ahead_since_s: seconds after which the page began to load the next box.
    """

    def __init__(self, project: Project, frames: Sequence[StoredFrame], quality: float) -> None:
        self.project, self.frames, self.quality = project, frames, quality
        self.bills: dict[TrackKey | None, Bill] = defaultdict(Bill)
        self.waits: dict[str, float] = defaultdict(float)
        self.ahead_since_s = 0.0
        self._source = FrameSource(project)
        self._opened: tuple[int, OpenFrame] | None = None
        self._things: dict[int, list[Thing]] = {}

    def things(self, frame: StoredFrame) -> list[Thing]:
        """The true objects of a frame."""
        if frame.id not in self._things:
            recording, read = self._source.recording(frame.recording_id), self.open(frame).frame
            classes = self.project.config.classes
            self._things[frame.id] = [
                Thing(
                    (truth.label, -1 if truth.track_id is None else truth.track_id),
                    truth.label,
                    truth.box,
                    box_on_image(read.camera, truth.box, truth.label) is not None
                    and int(contains(truth.box, read.cloud.xyz_m).sum()) >= MIN_VISIBLE_POINTS,
                )
                for truth in load_truth(recording, frame.index or 0, read)
                if truth.label in classes
            ]
        return self._things[frame.id]

    def look(self, frame: StoredFrame, box: OrientedBox, bill: Bill, is_ahead: bool = False) -> None:
        """Waits for the three pictures of a box, loaded ahead if it is the queue's next one, and looks at them."""
        opened = self.open(frame)
        begin = time.perf_counter()
        for view in ortho_views(opened, box, VIEW_PX).values():
            encoded_image(view.rgb)
        self.waited(bill, time.perf_counter() - begin, is_ahead)
        if is_ahead:
            # now the page loads the next one
            self.ahead_since_s = self.spent_s()
        bill.looks += 1

    def waited(self, bill: Bill, work_s: float, is_ahead: bool) -> None:
        """Counts what is left of work that the page may have done while the operator was busy."""
        if is_ahead:
            done_s = min(work_s, self.spent_s() - self.ahead_since_s)
            # the rest of that time is left for what else was loaded
            self.ahead_since_s += done_s
            work_s -= done_s
        bill.waiting_s += work_s

    def spent_s(self) -> float:
        return sum((each.seconds for each in self.bills.values()), 0.0)

    def is_right(self, label: Label, thing: Thing) -> bool:
        return label.label == thing.label and iou_3d(label.box, thing.box) >= self.quality

    def labels(self, frame: StoredFrame) -> tuple[Label, ...]:
        return self.project.labels.of_frame(frame.id)

    def open_labels(self, frame: StoredFrame) -> list[Label]:
        return [label for label in self.labels(frame) if label.state is ReviewState.PROPOSED]

    def store(self, frame: StoredFrame, payloads: list[Payload]) -> int:
        """Stores changes; returns how many open boxes have moved along."""
        context = WriteContext(self.project.frames.get(frame.id).revision, AUTHOR, effort=Effort(0, 0.0))
        return apply_changes(self.project, frame.id, payloads, context, lambda: self.open(frame))

    def enter(self, frame: StoredFrame) -> None:
        """Opens the next frame, which the server has read ahead while the operator was busy with the one before."""
        if self._opened is not None and self._opened[0] == frame.id:
            return
        begin = time.perf_counter()
        self.open(frame)
        self.waited(self.bills[None], time.perf_counter() - begin, is_ahead=True)
        if not self.open_labels(frame):
            self.ahead_since_s = self.spent_s()

    def open(self, frame: StoredFrame) -> OpenFrame:
        if self._opened is None or self._opened[0] != frame.id:
            self._opened = frame.id, OpenFrame(self._source.read(frame))
        return self._opened[1]

    def wait(self, kind: str, bill: Bill, work: Callable[[], T]) -> T:
        begin = time.perf_counter()
        result = work()
        self.waits[kind] = time.perf_counter() - begin
        bill.waiting_s += self.waits[kind]
        return result
