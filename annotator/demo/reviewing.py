"""A simulated operator who draws one 2D box per object, and reviews 3D proposals by the recording's truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from annotator.geometry.iou import iou_3d_matrix
from annotator.geometry.outline import box_on_image
from annotator.project import REVIEWED, FramePart, NewLabel, Origin, Project, StoredFrame, WriteContext
from annotator.project.log.event_types import LabelAccepted, LabelEdited, LabelRejected, LabelTracked, Payload
from annotator.project.log.records import BoxRecord
from annotator.rcv.config import RcvConfig
from annotator.rcv.teach import TaughtObject
from annotator.types import Box2D, BoxKind, Label, ReviewState, Source
from annotator.types.errors import StaleRevisionError, TrackTakenError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.proposing.lift import GivenBoxes, lift
from annotator.workflows.simulate import AUTHOR, visible_objects
from annotator.workflows.tracks.propose_boxes import next_track_id
from annotator.workflows.workbench.loaded_detectors import ReadyDetector

# The operator accepts a proposal with at least this IoU, and adjusts a worse one.
GOOD_IOU = 0.5
# A proposal with a lower IoU is not recognised as the object, and rejected.
SAME_IOU = 0.1
# Objects with fewer points are left out.
MIN_POINTS = 100
# If a viewer changes a frame while the operator does, it is read and changed again, at most so often.
TRIES = 5

Changed = TypeVar("Changed")


@dataclass
class Reviewed:
    """What the operator did.

    Attributes:
        drawn: number of 2D boxes drawn.
        accepted, adjusted, rejected: number of proposed 3D boxes.
        placed: number of 3D boxes placed by hand, because nothing was proposed for a drawn box.
        ious: IoU of each accepted or adjusted proposal with the truth.
    """

    drawn: int = 0
    accepted: int = 0
    adjusted: int = 0
    rejected: int = 0
    placed: int = 0
    ious: list[float] = field(default_factory=list)

    @property
    def boxes(self) -> int:
        """Number of reviewed 3D boxes."""
        return self.accepted + self.adjusted + self.placed


class SimulatedOperator:
    """Labels one recording of a project."""

    def __init__(self, project: Project, recording_id: int) -> None:
        """
        Raises:
            RecordingError: the recording cannot be read.
        """
        self.done = Reviewed()
        self._project, self._recording_id = project, recording_id
        self._source = FrameSource(project)
        self._recording = self._source.recording(recording_id)
        self._truths: dict[int, list[TaughtObject]] = {}

    def draw(self, stored: StoredFrame, view: ReadyDetector, config: RcvConfig) -> None:
        """Draws a 2D box around each object without a 3D box; 3D boxes of these objects are proposed."""
        camera = self._source.read(stored).camera

        def draw(context: WriteContext) -> tuple[Box2D, ...]:
            outlines = [box_on_image(camera, item.box, item.label) for item in self.missing(stored)]
            boxes = tuple(box for box in outlines if box is not None)
            known = next((drawn.boxes for drawn in self._project.boxes.on_images() if drawn.frame_id == stored.id), ())
            self._project.boxes.set_on_image(stored.id, [*known, *boxes], BoxKind.BOX, context)
            return boxes

        boxes = self._changed(stored, draw)
        self.done.drawn += len(boxes)
        lift(self._project, GivenBoxes("boxes drawn on the images", {stored.id: boxes}, {}), view, config)

    def missing(self, stored: StoredFrame) -> list[TaughtObject]:
        """The visible objects of a frame without a reviewed 3D box."""
        truths, labels = self._objects(stored), self._labels(stored, REVIEWED)
        ious = _ious(labels, truths)
        return [truth for truth, iou in zip(truths, ious.max(axis=0, initial=0.0), strict=True) if iou < SAME_IOU]

    def review(self, stored: StoredFrame) -> list[int]:
        """Accepts, adjusts or rejects all proposals of a frame; returns the tracks of the adjusted ones."""
        return self._changed(stored, lambda context: self._review(stored, context))

    def _review(self, stored: StoredFrame, context: WriteContext) -> list[int]:
        labels, truths = self._labels(stored, (ReviewState.PROPOSED,)), self._objects(stored)
        ious = _ious(labels, truths)
        payloads: list[Payload] = []
        taken: set[int] = set()
        tracks: list[int] = []
        accepted = adjusted = rejected = 0
        kept: list[float] = []
        for index in np.argsort(-ious.max(axis=1, initial=0.0)).tolist():
            label, best = labels[index], int(ious[index].argmax()) if truths else -1
            iou = float(ious[index, best]) if truths else 0.0
            if iou < SAME_IOU or best in taken:
                payloads.append(LabelRejected(uid=label.uid))
                rejected += 1
                continue
            taken.add(best)
            kept.append(iou)
            if iou >= GOOD_IOU:
                payloads.append(LabelAccepted(uid=label.uid))
                accepted += 1
            else:
                box = BoxRecord.of(truths[best].box)
                payloads.append(LabelEdited(uid=label.uid, label=label.label, box=box, track_id=label.track_id))
                adjusted += 1
                tracks += [] if label.track_id is None else [label.track_id]
        if payloads:
            self._project.log.append(stored.id, payloads, context)
        done = self.done
        done.accepted, done.adjusted = done.accepted + accepted, done.adjusted + adjusted
        done.rejected, done.ious = done.rejected + rejected, done.ious + kept
        return tracks

    def place(self, stored: StoredFrame) -> None:
        """Places the 3D boxes of objects for which nothing was proposed."""

        def place(context: WriteContext) -> int:
            new = [NewLabel(item.label, item.box, origin=Origin.PLACED) for item in self.missing(stored)]
            if new:
                self._project.labels.create(stored.id, new, context)
            return len(new)

        self.done.placed += self._changed(stored, place)

    def track(self, stored: StoredFrame) -> list[int]:
        """Gives the reviewed boxes without a track new ones; returns these."""

        def track(context: WriteContext) -> list[int]:
            untracked = [label for label in self._labels(stored, REVIEWED) if label.track_id is None]
            first = next_track_id(self._project, self._recording_id)
            tracks = list(range(first, first + len(untracked)))
            payloads = [LabelTracked(uid=at.uid, track_id=track) for at, track in zip(untracked, tracks, strict=True)]
            if payloads:
                self._project.log.append_to_frames([FramePart(stored.id, payloads, context)], new_tracks=tracks)
            return tracks

        return self._changed(stored, track)

    def reviewed_of(self, tracks: Sequence[int]) -> list[int]:
        """Returns the tracks that have a reviewed box; a viewer may have deleted those of the others."""
        chosen = self._project.labels.select(states=REVIEWED, recordings=[self._recording_id], tracks=tracks)
        present = {stored.label.track_id for stored in chosen}
        return [track for track in tracks if track in present]

    def _changed(self, stored: StoredFrame, change: Callable[[WriteContext], Changed]) -> Changed:
        """Changes a frame as it is now. If a viewer of the workbench is faster, the frame is read and changed again.

        Raises:
            StaleRevisionError, TrackTakenError: the viewer is faster again and again.
        """
        for attempt in range(TRIES):
            # the revision is read before the labels, so that a change in between is noticed
            context = WriteContext(self._project.frames.get(stored.id).revision, AUTHOR, Source.MANUAL)
            try:
                return change(context)
            except (StaleRevisionError, TrackTakenError):
                if attempt == TRIES - 1:
                    raise
        raise AssertionError

    def _labels(self, stored: StoredFrame, states: Sequence[ReviewState]) -> list[Label]:
        return [label for label in self._project.labels.of_frame(stored.id) if label.state in states]

    def _objects(self, stored: StoredFrame) -> list[TaughtObject]:
        if stored.id not in self._truths:
            index = self._recording.keys.index(stored.key)
            found = visible_objects(self._recording, index, self._source.read(stored), self._project.config.classes)
            self._truths[stored.id] = [
                item for item in found if item.points is not None and item.points.sum() >= MIN_POINTS
            ]
        return self._truths[stored.id]


def _ious(labels: Sequence[Label], truths: Sequence[TaughtObject]) -> np.ndarray:
    """IoU of each label (row) with each true object (column)."""
    if not labels or not truths:
        return np.zeros((len(labels), len(truths)))
    return iou_3d_matrix([label.box for label in labels], [truth.box for truth in truths])
