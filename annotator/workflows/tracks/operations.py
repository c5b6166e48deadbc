"""What is done to a whole track, or to a span of it: its class, its number (split and merge), its size, its values;
boxes are deleted, and gaps filled. Each is one action, whose effect is counted before it happens.

A track is seen from one recording of its rig. Rejected boxes, and those in finalised frames, stay as they are; a
reviewed box changes only if the count says so. An open proposal does not change so that it would cover a reviewed box.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from pydantic import ConfigDict, Field

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import same_box
from annotator.project import REVIEWED, Effort, FramePart, Project, StoredFrame, StoredLabel, WriteContext
from annotator.project.changes import ChangedValues, LabelChanged, LabelDeleted, Payload
from annotator.project.classes.attributes import Attribute, AttributeOf
from annotator.project.overview import read_page
from annotator.tracking.smooth import between
from annotator.types import Label, OrientedBox, ReviewState
from annotator.types.bases import Strict, TrackId
from annotator.types.errors import ConfigError, NotFoundError, StaleRevisionError
from annotator.types.label import MOST_TRACK, AttributeValue
from annotator.types.messages import alternatives, amount
from annotator.workflows.tracks.propose_boxes import changed_box, is_finalised, proposal_events, proposal_like
from annotator.workflows.tracks.timeline import Timeline
from annotator.workflows.workbench.drawing_steps import frame_config
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.loaded_detectors import ReadyDetector
from annotator.workflows.workbench.refit import refit
from annotator.workflows.workbench.save_object import parts_of


class Count(Strict):
    """What an operation does: numbers of boxes.

    `reviewed`: of those that are changed or deleted. Unchanged: `finalised` boxes, or frames to fill, in finalised
    frames, and `covered` ones where the object is labelled already, or was rejected. `number`: what the boxes get;
    `joined`: how many boxes have it before.
    """

    changed: int = 0
    proposed: int = 0
    deleted: int = 0
    reviewed: int = 0
    finalised: int = 0
    covered: int = 0
    number: int | None = None
    joined: int = 0

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
    """

    frame: StoredFrame
    events: Sequence[Payload]
    count: Count


FINALISED, COVERED = Count(finalised=1), Count(covered=1)


FitBox = Callable[[StoredFrame, OrientedBox, Label], OrientedBox]
"""(frame, box, label of the object in another frame) -> the box fitted to the frame's points.

The given box if the fit is rejected, or if the detector measures another kind of box than the label's.
"""


class Track:
    """A track as a recording sees it, within a span of frames.

    Attributes:
        fit: fits the boxes that fill a gap to the points of their frames, or None.
    """

    def __init__(self, project: Project, recording_id: int, track_id: int, span: Operation, fit: FitBox | None) -> None:
        recording = project.recordings.get(recording_id)
        self.project, self.recording_id, self.track_id, self.fit = project, recording_id, track_id, fit
        self.name = f"track {track_id} of {recording.name}"
        self.frames = {frame.id: frame for frame in project.frames.of([recording_id])}
        if not self.frames:
            raise NotFoundError(f"{recording.name} has no frames in the project")
        self.is_whole = span.first is None and span.last is None
        places = {id: place for place, id in enumerate(self.frames)}
        for end in (span.first, span.last):
            if end is not None and end not in places:
                raise NotFoundError(f"{recording.name} has no frame with id {end}")
        first = 0 if span.first is None else places[span.first]
        last = len(places) if span.last is None else places[span.last]
        if first > last:
            raise ConfigError("the span ends before it begins; give the earlier frame first")
        self.inside = {id for id, place in places.items() if first <= place <= last}

    def boxes(self, track_id: int | None = None) -> list[tuple[StoredFrame, StoredLabel]]:
        """Its boxes, or those of another track, in order, without rejected ones."""
        along = self.project.labels.along(self.recording_id, tracks=[self.track_id if track_id is None else track_id])
        return [(self.frames[each.frame_id], each) for each in along if each.label.state is not ReviewState.REJECTED]

    def each(self, change: Change) -> Iterator[Step]:
        """Yields what a function does to each of its boxes in the span: None, if that one needs no change."""
        for frame, stored in self.boxes():
            if frame.id not in self.inside or (events := change(frame, stored)) is None:
                continue
            if is_finalised(self.project, frame, stored):
                yield Step(frame, (), FINALISED)
            elif not events:
                yield Step(frame, (), COVERED)
            else:
                gone = sum(isinstance(each, LabelDeleted) and each.uid != stored.label.uid for each in events)
                reviewed = stored.label.state in REVIEWED
                yield Step(frame, events, Count(changed=1, deleted=gone, reviewed=reviewed))


Change = Callable[[StoredFrame, StoredLabel], Sequence[Payload] | None]
FrameId = Annotated[int, Field(ge=0, le=2**53)]


class _OfSpan(Strict):
    """From one frame of the recording to another (ids), both included; None: from the first, to the last."""

    model_config = ConfigDict(populate_by_name=True)

    first: FrameId | None = Field(None, alias="from")
    last: FrameId | None = Field(None, alias="to")


class SetClass(_OfSpan):
    """All boxes get a class."""

    do: Literal["class"] = "class"
    label: Annotated[str, Field(min_length=1, max_length=64)]

    def steps(self, track: Track) -> Iterator[Step]:
        classes = track.project.config.classes
        if self.label not in classes:
            raise NotFoundError(f"the project has no class {self.label!r}; {alternatives(self.label, classes)}")

        def change(frame: StoredFrame, stored: StoredLabel) -> Sequence[Payload] | None:
            if stored.label.label == self.label:
                return None
            return changed_box(track.project, frame, stored, label=self.label)

        return track.each(change)


class SetNumber(_OfSpan):
    """The boxes get the number of another track, which may have boxes, or (null) a new one: this splits and merges.

    In a frame where both tracks have a box, the reviewed one stays, or else that of this track; the other is deleted.
    """

    do: Literal["number"] = "number"
    number: TrackId | None = None

    def steps(self, track: Track) -> Iterator[Step]:
        number = track.project.labels.next_track_id(track.recording_id) if self.number is None else self.number
        if number == track.track_id:
            raise ConfigError(f"{track.name} has this number already; give another one")
        there = {frame.id: stored for frame, stored in track.boxes(number)}
        yield Step(next(iter(track.frames.values())), (), Count(number=number, joined=len(there)))
        for frame, stored in track.boxes():
            if frame.id not in track.inside:
                continue
            other = there.get(frame.id)
            if any(is_finalised(track.project, frame, each) for each in (stored, other) if each is not None):
                yield Step(frame, (), FINALISED)
                continue
            numbered = LabelChanged(uid=stored.label.uid, track_id=number)
            own, its = (each is not None and each.label.state in REVIEWED for each in (stored, other))
            if other is None:
                yield Step(frame, [numbered], Count(changed=1, reviewed=own))
            elif its and not own:
                yield Step(frame, [LabelDeleted(uid=stored.label.uid)], Count(deleted=1))
            else:
                count = Count(changed=1, deleted=1, reviewed=own + its)
                yield Step(frame, [LabelDeleted(uid=other.label.uid), numbered], count)


Length = Annotated[float, Field(ge=1e-4, le=1e4, allow_inf_nan=False)]


class SetSize(_OfSpan):
    """All boxes get one size (length, width, height), metres, as a rigid object has it; see `resized`."""

    do: Literal["size"] = "size"
    size_m: tuple[Length, Length, Length]

    def steps(self, track: Track) -> Iterator[Step]:
        def change(frame: StoredFrame, stored: StoredLabel) -> Sequence[Payload] | None:
            box = resized(stored.label.box, self.size_m)
            return None if same_box(box, stored.label.box) else changed_box(track.project, frame, stored, box=box)

        return track.each(change)


def resized(box: OrientedBox, size_m: Sequence[float]) -> OrientedBox:
    """A box of another size with the same rotation and bottom, and with those of its sides that face the camera, since
    points lie on these. If the camera is between two sides, both move alike."""
    half_m, new_m = box.size_m / 2, np.asarray(size_m) / 2
    camera_m = box.rotation.T @ -box.center_m
    facing = np.where(np.abs(camera_m) > half_m, np.sign(camera_m), 0.0)
    facing[2] = -1.0
    center_m = box.center_m + box.rotation @ (facing * (half_m - new_m))
    return OrientedBox.from_parts(center_m, box.rotation, 2 * new_m)


class SetValues(_OfSpan):
    """The boxes get values of attributes; null removes one. Those of an attribute of tracks are for whole tracks."""

    do: Literal["values"] = "values"
    values: Annotated[ChangedValues, Field(min_length=1)]

    def steps(self, track: Track) -> Iterator[Step]:
        known = {each.name: each for each in track.project.config.attributes if each.of is not AttributeOf.FRAME}
        values = {name: self._checked(known, name, track) for name in self.values}

        def change(_: StoredFrame, stored: StoredLabel) -> Sequence[Payload] | None:
            label = stored.label
            new = {
                name: value
                for name, value in values.items()
                if known[name].is_of(label.label) and label.attributes.get(name) != value
            }
            return [LabelChanged(uid=label.uid, attributes=new)] if new else None

        return track.each(change)

    def _checked(self, known: dict[str, Attribute], name: str, track: Track) -> AttributeValue | None:
        if name not in known:
            raise NotFoundError(f"boxes have no attribute {name!r}; {alternatives(name, known)}")
        if known[name].of is AttributeOf.TRACK and not track.is_whole:
            raise ConfigError(f"{name} is an attribute of tracks, so it has one value in all frames; give no frames")
        value = self.values[name]
        try:
            return None if value is None else known[name].checked(value)
        except ValueError as error:
            raise ConfigError(str(error)) from error


class Delete(_OfSpan):
    """The boxes are removed; the object may be proposed again."""

    do: Literal["delete"] = "delete"

    def steps(self, track: Track) -> Iterator[Step]:
        for step in track.each(lambda _, stored: [LabelDeleted(uid=stored.label.uid)]):
            yield replace(step, count=step.count.model_copy(update={"changed": 0, "deleted": step.count.changed}))


class Fill(_OfSpan):
    """A box is proposed in each frame that has none and is between two boxes of the track.

    Centre, size and rotation are interpolated by the frames' times if they are recorded, else by their indices; with
    `refit`, each box is fitted to the points of its frame.
    """

    do: Literal["fill"] = "fill"
    refit: bool = False

    def steps(self, track: Track) -> Iterator[Step]:
        timeline = Timeline(track.project, track.recording_id)
        times = timeline.times.tolist()
        boxes = [(timeline.index[frame.id], each) for frame, each in track.boxes() if frame.id in timeline.index]
        for (start, before), (end, after) in pairwise(boxes):
            gap = [place for place in range(start + 1, end) if timeline.frames[place].id in track.inside]
            ends = times[start], times[end]
            filled = between(before.label.box, after.label.box, *ends, [times[place] for place in gap])
            for place, box in zip(gap, filled, strict=True):
                frame = timeline.frames[place]
                if frame.finalised:
                    yield Step(frame, (), FINALISED)
                    continue
                # the values of the box that is nearer in time
                is_later = times[place] - ends[0] > ends[1] - times[place] and after.label.label == before.label.label
                values = (after if is_later else before).label.attributes
                new = proposal_like(before.label, box, track.track_id, attributes=values)
                if not (events := proposal_events(track.project, frame, [new])):
                    yield Step(frame, (), COVERED)
                    continue
                gone = sum(isinstance(each, LabelDeleted) for each in events)
                if self.refit and track.fit is not None:
                    fitted = replace(new, box=track.fit(frame, box, before.label))
                    events = proposal_events(track.project, frame, [fitted]) or events
                yield Step(frame, events, Count(proposed=1, deleted=gone))


Operation = SetClass | SetNumber | SetSize | SetValues | Delete | Fill
AnyOperation = Annotated[Operation, Field(discriminator="do")]

# Attempts to apply an operation to frames that change at the same time.
ATTEMPTS = 5


def apply(
    project: Project,
    recording_id: int,
    track_id: int,
    operation: Operation,
    author: str,
    *,
    dry_run: bool = False,
    told: Count | None = None,
    fit: FitBox | None = None,
    effort: Effort | None = None,
    at: int | None = None,
) -> Count:
    """Applies an operation to a track, as one action; returns what it has done, or (`dry_run`) would do.

    Args:
        told: the count that the operator was told; nothing changes if it is another one by now.
        fit: for `Fill.refit`.
        at: the frame in which the operator is: an undo comes back to it.

    Raises:
        ConfigError: there is nothing to do, or the count is another one; says which.
        NotFoundError: no such recording, frame, class or attribute.
    """
    if abs(track_id) > MOST_TRACK:
        raise ConfigError(f"track ids are at most {MOST_TRACK}, not {track_id:.6g}; give the id of a track")
    new_track = isinstance(operation, SetNumber) and operation.number is None
    for _ in range(ATTEMPTS):
        with project.store.snapshot():
            track = Track(project, recording_id, track_id, operation, None if dry_run else fit)
            steps = list(operation.steps(track))
            count = _sum([step.count for step in steps])
            if not (count.changed or count.proposed or count.deleted):
                raise ConfigError(_nothing(track, operation, count))
            if told is not None and told != count:
                raise ConfigError(f"{track.name} was changed in the meantime: this now {count.words()}; look again")
            if dry_run:
                return count
            changed = sorted((step for step in steps if step.events), key=lambda step: step.frame.id != at)
            parts: list[FramePart] = []
            for step in changed:
                context = WriteContext(step.frame.revision, author, effort=None if parts else effort)
                parts += parts_of(project, read_page(project, step.frame.id), step.events, context)
        try:
            project.log.append_to_frames(parts, new_tracks=[count.number] if new_track and count.number else [])
        except StaleRevisionError:
            continue
        return count
    raise ConfigError(f"{track.name} is being changed by others; try again once they have finished")


def _sum(counts: Sequence[Count]) -> Count:
    names = [name for name in Count.model_fields if name != "number"]
    number = next((each.number for each in counts if each.number is not None), None)
    return Count(**{name: sum(getattr(each, name) for each in counts) for name in names}, number=number)


def _nothing(track: Track, operation: Operation, count: Count) -> str:
    if not track.boxes():
        return f"{track.name} has no boxes"
    if isinstance(operation, Fill) and not count.left():
        return f"{track.name} has no frame without a box between two of its boxes there"
    left = f" (unchanged: {count.left()})" if count.left() else ""
    return f"there is nothing to change: {track.name} has no box in these frames, or all are so already{left}"


# 3D IoU of the fitted with the given box below which the fit is rejected: it has found another object, or a part.
MIN_IOU = 0.4


def box_fitter(
    project: Project, open_frame: Callable[[StoredFrame], OpenFrame], detector: ReadyDetector | None
) -> FitBox:
    """Returns a function that fits boxes with `refit`.

    Args:
        open_frame: returns a frame; its errors are passed on.
        detector: for pseudo-views; without one the sides move to the points inside.
    """

    def fit(frame: StoredFrame, box: OrientedBox, label: Label) -> OrientedBox:
        opened = open_frame(frame)
        config = frame_config(project, opened.frame, detector, label.box_kind)
        if detector is not None and config.box_kind is not label.box_kind:
            return box
        fitted = refit(opened, box, label.label, config, detector).box or box
        return fitted if iou_3d(fitted, box) >= MIN_IOU else box

    return fit
