"""Carries the reviewed boxes of a frame to the next frame, by detection or by copying."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from annotator.project import REVIEWED, Effort, FramePart, Project, Receipt, StoredFrame, StoredLabel
from annotator.project.event_types import LabelTracked
from annotator.project.overview import neighbours, read_page
from annotator.rcv.propose import propose
from annotator.rcv.warm_start import WarmStart
from annotator.tracking.config import TrackingConfig
from annotator.tracking.motion import predicted
from annotator.types import OrientedBox
from annotator.types.errors import ConfigError, NotFoundError, StaleRevisionError
from annotator.workflows.detectors import Detectors
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks.fit_boxes import FitBox
from annotator.workflows.tracks.previous_boxes import match_proposals
from annotator.workflows.tracks.propose_boxes import NewProposal, next_track_id, part_of, proposal_events
from annotator.workflows.tracks.times import times_of
from annotator.workflows.workbench.drawing_steps import frame_config
from annotator.workflows.workbench.open_frame import OpenFrame


@dataclass(frozen=True)
class Followed:
    """The result of following objects to the next frame.

    Attributes:
        frame_id: the next frame.
        changed: the changed frames: (frame id, receipt) each.
        proposed: number of boxes proposed in the next frame.
        lost: number of objects that the detectors did not find again.
    """

    frame_id: int
    changed: tuple[tuple[int, Receipt], ...]
    proposed: int
    lost: int


def propose_next(
    project: Project,
    frame_id: int,
    revision: int,
    author: str,
    detectors: Detectors,
    open_frame: Callable[[StoredFrame], OpenFrame],
    *,
    effort: Effort | None = None,
) -> Followed:
    """Proposes boxes in the next frame, starting from this frame's reviewed boxes. Objects keep their track ids.

    Args:
        revision: of the frame, as shown to the operator.
        author: the operator, who can undo this as one action.
        open_frame: returns the next frame.

    Raises:
        ConfigError: the recording is not a sequence, there is no next frame, it is finalised, or this frame has no
            reviewed box.
        StaleRevisionError: one of the frames was changed in the meantime.
        NotFoundError, RecordingError, FrameError: no such frame, or the next one cannot be read.
    """
    step = _Step.of(project, frame_id, revision, None)
    frame = open_frame(step.next_frame).frame
    config = detectors.settings(frame_config(project, frame))
    seeds = [WarmStart(stored.label.label, stored.label.box) for stored in step.labels]
    proposals = propose([frame], detectors.image, detectors.view, config, [seeds], detectors.compute)[0].proposals
    matches = match_proposals([stored.label for stored in step.labels], proposals)
    ids = step.track_ids([index is not None for index in matches])
    track_of = {index: ids[number] for number, index in enumerate(matches) if index is not None}
    boxes = [NewProposal(each.label, each.box, track_of.get(index), each) for index, each in enumerate(proposals)]
    return step.store(boxes, ids, author, effort, lost=matches.count(None))


def copy_next(
    project: Project,
    frame_id: int,
    revision: int,
    author: str,
    *,
    uid: str | None = None,
    fit: FitBox | None = None,
    effort: Effort | None = None,
) -> Followed:
    """Proposes the boxes of a frame in the next one, moved along their tracks.

    Args:
        revision, author: as for `propose_next`.
        uid: only this label, reviewed or not; None = all reviewed labels.
        fit: fits each box to the next frame's points.

    Raises:
        ConfigError, StaleRevisionError, NotFoundError, RecordingError, FrameError: as `propose_next`.
    """
    step = _Step.of(project, frame_id, revision, uid)
    moved = [_moved(project, step, stored) for stored in step.labels]
    if fit is not None:
        labels = [stored.label.label for stored in step.labels]
        moved = [fit(step.next_frame, box, label) for box, label in zip(moved, labels, strict=True)]
    ids = step.track_ids([True] * len(moved))
    boxes = [NewProposal(each.label.label, box, id) for each, box, id in zip(step.labels, moved, ids, strict=True)]
    return step.store(boxes, ids, author, effort, lost=0)


@dataclass(frozen=True, eq=False)
class _Step:
    """A frame, the next frame, and the labels to carry over."""

    project: Project
    frame: StoredFrame
    next_frame: StoredFrame
    labels: tuple[StoredLabel, ...]

    @classmethod
    def of(cls, project: Project, frame_id: int, revision: int, uid: str | None) -> _Step:
        page = read_page(project, frame_id)
        frame = page.frame
        recording = project.recordings.get(frame.recording_id)
        if not recording.is_sequence:
            raise ConfigError(f"the frames of {recording.name} do not follow each other in time; there is no next one")
        if frame.revision != revision:
            raise StaleRevisionError(f"frame {frame.key}", revision, frame.revision)
        if uid is None:
            labels = tuple(stored for stored in page.labels if stored.label.state in REVIEWED)
        else:
            labels = tuple(stored for stored in page.labels if stored.label.uid == uid)
        next_id = neighbours(project, frame)[1]
        if next_id is None:
            raise ConfigError(f"frame {frame.key} is the last of its recording; there is no next frame")
        if not labels and uid is not None:
            raise NotFoundError(f"frame {frame.key} has no label {uid}; reload the frame")
        if not labels:
            raise ConfigError(f"frame {frame.key} has no reviewed box to start from; accept one first")
        next_frame = project.frames.get(next_id)
        if next_frame.finalised:
            raise ConfigError(f"frame {next_frame.key} is finalised; reopen it first")
        return cls(project, frame, next_frame, labels)

    def track_ids(self, is_followed: Sequence[bool]) -> list[int | None]:
        """Returns the track id of each label; a new one for followed labels without one."""
        next_id = next_track_id(self.project, self.frame.recording_id)
        ids = []
        for stored, has_next in zip(self.labels, is_followed, strict=True):
            track_id = stored.label.track_id
            if track_id is None and has_next:
                track_id, next_id = next_id, next_id + 1
            ids.append(track_id)
        return ids

    def store(
        self,
        boxes: Sequence[NewProposal],
        track_ids: Sequence[int | None],
        author: str,
        effort: Effort | None,
        lost: int,
    ) -> Followed:
        """Proposes boxes in the next frame, and sets the new track ids of this frame's labels."""
        payloads = proposal_events(self.project, self.next_frame, boxes)
        if not payloads:
            reason = "the detectors found no object" if not boxes else "it already has all of these boxes"
            raise ConfigError(f"nothing was proposed in frame {self.next_frame.key}: {reason}")
        tracked = [
            LabelTracked(uid=stored.label.uid, track_id=number)
            for stored, number in zip(self.labels, track_ids, strict=True)
            if number != stored.label.track_id
        ]
        parts: list[FramePart] = [part_of(self.next_frame, payloads, author, effort)]
        if tracked:
            parts.append(part_of(self.frame, tracked, author))
        receipts = self.project.log.append_to_frames(parts)
        changed = tuple((part.frame_id, receipt) for part, receipt in zip(parts, receipts, strict=True))
        proposed = sum(payload.kind == "label_proposed" for payload in payloads)
        return Followed(self.next_frame.id, changed, proposed, lost)


def _moved(project: Project, step: _Step, stored: StoredLabel) -> OrientedBox:
    """Returns a label's box moved to the next frame by the motion of its track's last reviewed boxes."""
    label = stored.label
    if label.track_id is None:
        return label.box
    frames = [frame for frame in project.frames.of([step.frame.recording_id]) if frame.index is not None]
    indices = {frame.id: index for index, frame in enumerate(frames)}
    here, config = indices[step.frame.id], TrackingConfig()
    earlier = {
        indices[other.frame_id]: other.label.box
        for other in project.labels.select(
            states=REVIEWED, recordings=[step.frame.recording_id], tracks=[label.track_id]
        )
        if here - config.max_gap <= indices.get(other.frame_id, here) < here
    }
    known = sorted(earlier)[1 - config.motion_boxes :]
    times = times_of(FrameSource(project).recording(step.frame.recording_id), frames)
    boxes = [*(earlier[index] for index in known), label.box]
    return predicted(boxes, times[np.array([*known, here])].tolist(), float(times[here + 1]))
