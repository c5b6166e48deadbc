"""From a reviewed frame to the next one: its objects are looked for where they were, or their boxes are copied."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from annotator.project import REVIEWED, Effort, FramePart, Project, Receipt, StoredFrame, StoredLabel
from annotator.project.overview import neighbours, read_page
from annotator.project.payloads import LabelTracked
from annotator.rcv.config import RcvConfig
from annotator.rcv.propose import propose
from annotator.rcv.seeds import Seed
from annotator.tracking.config import TrackingConfig
from annotator.tracking.motion import predicted
from annotator.types import OrientedBox
from annotator.types.errors import ConfigError, StaleRevisionError
from annotator.workflows.detectors import Detectors
from annotator.workflows.frames import FrameSource
from annotator.workflows.labelling import frame_config
from annotator.workflows.open_frame import OpenFrame
from annotator.workflows.tracks.place import Wanted, next_track_id, part_of, proposing
from annotator.workflows.tracks.seeds import owners
from annotator.workflows.tracks.snap import Snap
from annotator.workflows.tracks.times import times_of


@dataclass(frozen=True)
class Followed:
    """What was proposed in the next frame.

    Attributes:
        frame_id: the next frame.
        changed: ids of the frames that were changed, and the receipt of each.
        proposed: boxes that were proposed in it.
        lost: objects of the frame before that the detectors did not find again.
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
    """Proposes boxes in the next frame, starting from this one's reviewed boxes; an object keeps its track.

    Args:
        revision: of the frame, as the operator has seen it.
        author: who asks for it, and can undo it: one action.
        open_frame: gives the next frame.

    Raises:
        ConfigError: there is no next frame (frames without an order in time have none), it is finalised, or this one
            has no reviewed box.
        StaleRevisionError: somebody has changed one of the frames meanwhile.
        NotFoundError, RecordingError, FrameError: no such frame, or the next one cannot be read.
    """
    step = _Step.of(project, frame_id, revision, None)
    frame = open_frame(step.following).frame
    config: RcvConfig = frame_config(project, frame).model_copy(update={"box_kind": detectors.box_kind})
    seeds = [Seed(stored.label.label, stored.label.box) for stored in step.labels]
    found = propose([frame], detectors.image, detectors.view, config, [seeds], detectors.compute)[0].proposals
    places = owners([stored.label for stored in step.labels], found)
    ids = step.track_ids([place is not None for place in places])
    track_of = {place: ids[number] for number, place in enumerate(places) if place is not None}
    wanted = [Wanted(each.label, each.box, track_of.get(place), each) for place, each in enumerate(found)]
    return step.store(wanted, ids, author, effort, lost=places.count(None))


def copy_next(
    project: Project,
    frame_id: int,
    revision: int,
    author: str,
    *,
    uid: str | None = None,
    snap: Snap | None = None,
    effort: Effort | None = None,
) -> Followed:
    """Proposes reviewed boxes of a frame in the next one, moved as their tracks move.

    Args:
        revision, author: as of `propose_next`.
        uid: of this label only, reviewed or not; None = of all reviewed ones.
        snap: fits every box to the next frame's points.

    Raises:
        ConfigError, StaleRevisionError, NotFoundError, RecordingError, FrameError: as `propose_next`.
    """
    step = _Step.of(project, frame_id, revision, uid)
    moved = [_moved(project, step, stored) for stored in step.labels]
    if snap is not None:
        labels = [stored.label.label for stored in step.labels]
        moved = [snap(step.following, box, label) for box, label in zip(moved, labels, strict=True)]
    ids = step.track_ids([True] * len(moved))
    wanted = [Wanted(stored.label.label, box, own) for stored, box, own in zip(step.labels, moved, ids, strict=True)]
    return step.store(wanted, ids, author, effort, lost=0)


@dataclass(frozen=True, eq=False)
class _Step:
    """A frame, the labels that are followed, and the frame behind it."""

    project: Project
    frame: StoredFrame
    following: StoredFrame
    labels: tuple[StoredLabel, ...]

    @classmethod
    def of(cls, project: Project, frame_id: int, revision: int, uid: str | None) -> _Step:
        page = read_page(project, frame_id)
        frame = page.frame
        recording = project.recordings.get(frame.recording_id)
        if not recording.is_sequence:
            raise ConfigError(f"the frames of {recording.name} do not follow each other in time; none is the next one")
        if frame.revision != revision:
            raise StaleRevisionError(f"frame {frame.key}", revision, frame.revision)
        if uid is None:
            labels = tuple(stored for stored in page.labels if stored.label.state in REVIEWED)
        else:
            labels = tuple(stored for stored in page.labels if stored.label.uid == uid)
        after = neighbours(project, frame)[1]
        if after is None:
            raise ConfigError(f"frame {frame.key} is the last of its recording; there is none to go on in")
        if not labels:
            raise ConfigError(f"frame {frame.key} has no reviewed box to start from; accept one first")
        following = project.frames.get(after)
        if following.finalised:
            raise ConfigError(f"frame {following.key} is finalised; reopen it first")
        return cls(project, frame, following, labels)

    def track_ids(self, is_followed: Sequence[bool]) -> list[int | None]:
        """The track of each label; a new one for those that have none and are followed."""
        fresh = next_track_id(self.project, self.frame.recording_id)
        found = []
        for stored, is_new in zip(self.labels, is_followed, strict=True):
            number = stored.label.track_id
            if number is None and is_new:
                number, fresh = fresh, fresh + 1
            found.append(number)
        return found

    def store(
        self,
        wanted: Sequence[Wanted],
        track_ids: Sequence[int | None],
        author: str,
        effort: Effort | None,
        lost: int,
    ) -> Followed:
        """Proposes boxes in the frame behind, and gives labels the tracks that they lack."""
        payloads = proposing(self.project, self.following, wanted)
        if not payloads:
            none_found = "the detectors find nothing there" if not wanted else "all boxes are there already"
            raise ConfigError(f"nothing was proposed in frame {self.following.key}: {none_found}")
        named = [
            LabelTracked(uid=stored.label.uid, track_id=number)
            for stored, number in zip(self.labels, track_ids, strict=True)
            if number != stored.label.track_id
        ]
        parts: list[FramePart] = [part_of(self.following, payloads, author, effort)]
        if named:
            parts.append(part_of(self.frame, named, author))
        receipts = self.project.log.append_to_frames(parts)
        changed = tuple((part.frame_id, receipt) for part, receipt in zip(parts, receipts, strict=True))
        proposed = sum(payload.kind == "label_proposed" for payload in payloads)
        return Followed(self.following.id, changed, proposed, lost)


def _moved(project: Project, step: _Step, stored: StoredLabel) -> OrientedBox:
    """A label's box where its track's last reviewed boxes lead in the next frame."""
    label = stored.label
    if label.track_id is None:
        return label.box
    frames = [frame for frame in project.frames.of([step.frame.recording_id]) if frame.index is not None]
    places = {frame.id: place for place, frame in enumerate(frames)}
    here, config = places[step.frame.id], TrackingConfig()
    earlier = {
        places[other.frame_id]: other.label.box
        for other in project.labels.select(
            states=REVIEWED, recordings=[step.frame.recording_id], tracks=[label.track_id]
        )
        if here - config.max_gap <= places.get(other.frame_id, here) < here
    }
    known = sorted(earlier)[1 - config.motion_boxes :]
    times = times_of(FrameSource(project).recording(step.frame.recording_id), frames)
    boxes = [*(earlier[place] for place in known), label.box]
    return predicted(boxes, times[np.array([*known, here])].tolist(), float(times[here + 1]))
