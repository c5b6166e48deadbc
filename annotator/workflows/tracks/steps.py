"""The boxes of a track, and what an operation on it does in each frame, counted before it happens.

A track is seen from one recording of its rig. Rejected boxes, and those in finalised frames, stay as they are; a
reviewed box changes only if the count says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

from pydantic import ConfigDict, Field

from annotator.project import REVIEWED, Project, StoredFrame, StoredLabel
from annotator.project.changes import LabelDeleted, Payload
from annotator.types import OrientedBox, ReviewState
from annotator.types.bases import Strict
from annotator.types.errors import ConfigError, NotFoundError
from annotator.types.messages import amount
from annotator.workflows.tracks.propose_boxes import Surroundings
from annotator.workflows.tracks.timeline import OpenRecording

Length = Annotated[float, Field(ge=1e-4, le=1e4, allow_inf_nan=False)]
Size = tuple[Length, Length, Length]


class Count(Strict):
    """What an operation does: numbers of boxes.

    `reviewed`: of those that are changed or deleted. Unchanged: `finalised` boxes, or frames to fill, in finalised
    frames, and `covered` ones where the object is labelled already, or was rejected. `number`, `size_m`: what the boxes
    get; `joined`: how many boxes have the number before.
    """

    changed: int = 0
    proposed: int = 0
    deleted: int = 0
    reviewed: int = 0
    finalised: int = 0
    covered: int = 0
    number: int | None = None
    joined: int = 0
    size_m: Size | None = None

    def words(self) -> str:
        """Such as "changes 25 boxes, 3 of them reviewed; unchanged: 2 in finalised frames"."""
        if self.proposed:
            replaced = f" in place of {amount(self.deleted, 'other proposal')}" if self.deleted else ""
            said = f"proposes {amount(self.proposed, 'box')}{replaced}"
        else:
            done = ("changes", self.changed), ("deletes", self.deleted)
            said = " and ".join(f"{verb} {amount(number, 'box')}" for verb, number in done if number)
            said += f", {self.reviewed or 'none'} of them reviewed"
        if self.number is not None:
            of_track = f"that of {amount(self.joined, 'other box')}" if self.joined else "a new one"
            said += f"; their number is {self.number}, {of_track}"
        if self.size_m is not None:
            said += f"; they get {' x '.join(f'{side:.2f}' for side in self.size_m)} m"
        return f"{said}; unchanged: {self.left()}" if self.left() else said

    def left(self) -> str:
        """What stays as it is, and why."""
        kinds = (self.finalised, "in finalised frames"), (self.covered, "where a box is reviewed or rejected already")
        return ", ".join(f"{number} {why}" for number, why in kinds if number)


@dataclass(frozen=True)
class Step:
    """What an operation does in one frame.

    Attributes:
        count: of this frame.
        sees: uid of an object that stands still from now on; this frame has had a box of it.
    """

    frame: StoredFrame
    events: Sequence[Payload]
    count: Count
    sees: str | None = None


# Of a `Count`: what the boxes get, not how many they are.
GIVEN = ("number", "size_m")
FINALISED, COVERED = Count(finalised=1), Count(covered=1)


def is_rejected(stored: StoredLabel) -> bool:
    """Whether a person has rejected a box."""
    return stored.label.state is ReviewState.REJECTED


class Track:
    """A track as a recording sees it, within a span of frames."""

    def __init__(
        self, project: Project, recording_id: int, track_id: int, span: OfSpan, recordings: OpenRecording | None
    ) -> None:
        recording = project.recordings.get(recording_id)
        self.project, self.recording_id, self.track_id, self.recordings = project, recording_id, track_id, recordings
        self.name = f"track {track_id} of {recording.name}"
        self.frames = {frame.id: frame for frame in project.frames.of([recording_id])}
        if not self.frames:
            raise NotFoundError(f"{recording.name} has no frames in the project")
        self.is_whole = span.first is None and span.last is None
        # a frame that is no longer in the recording is neither before nor after another one
        places = {id: frame.index for id, frame in self.frames.items() if frame.index is not None}
        for end in (span.first, span.last):
            if end is not None and end not in places:
                raise NotFoundError(f"{recording.name} has no frame with id {end}")
        first = 0 if span.first is None else places[span.first]
        last = max(places.values(), default=0) if span.last is None else places[span.last]
        if first > last:
            raise ConfigError("the span ends before it begins; give the earlier frame first")
        self.inside = {id for id in self.frames if self.is_whole or first <= places.get(id, -1) <= last}

    @cached_property
    def boxes(self) -> list[tuple[StoredFrame, StoredLabel]]:
        """Its boxes in order, without rejected ones."""
        return self.boxes_of(self.track_id)

    def boxes_of(self, track_id: int) -> list[tuple[StoredFrame, StoredLabel]]:
        """The boxes of another track, as `boxes`."""
        found = dict[str, StoredLabel]()
        for each in self.project.labels.along(self.recording_id, tracks=[track_id]):
            if not is_rejected(each):
                # one that stands still has the same box in all frames
                found.setdefault(each.still or each.label.uid, each)
        return [(self.frames[each.frame_id], each) for each in found.values()]

    def of_frames(self) -> list[tuple[StoredFrame, StoredLabel]]:
        """Its box in each frame, rejected ones too."""
        along = self.project.labels.along(self.recording_id, tracks=[self.track_id])
        return [(self.frames[each.frame_id], each) for each in along]

    def in_span(self) -> list[tuple[StoredFrame, StoredLabel]]:
        """Its boxes in the span."""
        return [(frame, stored) for frame, stored in self.boxes if frame.id in self.inside]

    def around(self, boxes: Iterable[tuple[StoredFrame, OrientedBox]] | None = None) -> Surroundings:
        """The surroundings of its boxes in the span, or of others that it is to have."""
        boxes = ((frame, stored.label.box) for frame, stored in self.in_span()) if boxes is None else boxes
        return Surroundings(self.project, [(frame, box, self.track_id) for frame, box in boxes])

    def each(self, there: Surroundings, change: Change) -> Iterator[Step]:
        """Yields what a function does to each of its boxes in the span: None, if that one needs no change."""
        for frame, stored in self.in_span():
            if (events := change(frame, stored)) is None:
                continue
            if there.is_finalised(frame, stored):
                yield Step(frame, (), FINALISED)
            elif not events:
                yield Step(frame, (), COVERED)
            else:
                gone = sum(isinstance(each, LabelDeleted) and each.uid != stored.label.uid for each in events)
                reviewed = stored.label.state in REVIEWED
                yield Step(frame, events, Count(changed=1, deleted=gone, reviewed=reviewed))


Change = Callable[[StoredFrame, StoredLabel], Sequence[Payload] | None]
FrameId = Annotated[int, Field(ge=0, le=2**53)]


class OfSpan(Strict):
    """From one frame of the recording to another (ids), both included; None: from the first, to the last."""

    model_config = ConfigDict(populate_by_name=True)

    first: FrameId | None = Field(None, alias="from")
    last: FrameId | None = Field(None, alias="to")
