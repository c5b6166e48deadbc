"""What is done to a whole track, or to a span of it: its class, its number (split and merge), its size, its values, its
motion; boxes are deleted, and gaps filled. Each is one action, whose effect is counted before it happens.

A track is seen from one recording of its rig. Rejected boxes, and those in finalised frames, stay as they are; a
reviewed box changes only if the count says so. An open proposal does not change so that it would cover a reviewed box.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from annotator.geometry.oriented_box import same_box
from annotator.project import REVIEWED, Effort, Project, StoredFrame, StoredLabel, WriteContext, new_action
from annotator.project.changes import (
    ChangedValues,
    LabelChanged,
    LabelDeleted,
    NewLabel,
    Payload,
)
from annotator.project.classes.attributes import Attribute, AttributeOf
from annotator.project.lanes import read_lanes
from annotator.project.stills import Sighting
from annotator.tracking.common_size import SizedBox, common_size
from annotator.tracking.link import MAX_GAP, MOTION_BOXES, predicted
from annotator.tracking.smooth import between
from annotator.types import OrientedBox
from annotator.types.bases import TrackId
from annotator.types.errors import ConfigError, NotFoundError, RecordingError, StaleRevisionError
from annotator.types.label import MOST_TRACK, AttributeValue
from annotator.types.messages import alternatives
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks.propose_boxes import changed_box, proposal_events, proposal_like
from annotator.workflows.tracks.steps import (
    COVERED,
    FINALISED,
    GIVEN,
    Count,
    OfSpan,
    Size,
    Step,
    Track,
    is_rejected,
)
from annotator.workflows.tracks.still_objects import Move, StandStill
from annotator.workflows.tracks.timeline import Motion, OpenRecording, Timeline
from annotator.workflows.workbench.save_object import frame_parts, parts_of_frames


class SetClass(OfSpan):
    """All boxes get a class."""

    do: Literal["class"] = "class"
    label: Annotated[str, Field(min_length=1, max_length=64)]

    def steps(self, track: Track) -> Iterator[Step]:
        classes = track.project.config.classes
        if self.label not in classes:
            raise NotFoundError(f"the project has no class {self.label!r}; {alternatives(self.label, classes)}")

        there = track.around()

        def change(frame: StoredFrame, stored: StoredLabel) -> Sequence[Payload] | None:
            if stored.label.label == self.label:
                return None
            return changed_box(there, frame, stored, label=self.label)

        return track.each(there, change)


class SetNumber(OfSpan):
    """The boxes get the number of another track, which may have boxes, or (null) a new one: this splits and merges.

    In a frame where both tracks have a box, the reviewed one stays, or else that of this track; the other is deleted.
    """

    do: Literal["number"] = "number"
    number: TrackId | None = None

    def steps(self, track: Track) -> Iterator[Step]:
        number = track.project.labels.next_track_id(track.recording_id) if self.number is None else self.number
        if number == track.track_id:
            raise ConfigError(f"{track.name} has this number already; give another one")
        there = {frame.id: stored for frame, stored in track.boxes_of(number)}
        yield Step(next(iter(track.frames.values())), (), Count(number=number, joined=len(there)))
        around = track.around()
        for frame, stored in track.in_span():
            other = there.get(frame.id)
            if any(around.is_finalised(frame, each) for each in (stored, other) if each is not None):
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


class Merge(OfSpan):
    """As `SetNumber`, with the number of another track; null = that of the likeliest one (`likeliest`)."""

    do: Literal["merge"] = "merge"
    number: TrackId | None = None

    def steps(self, track: Track) -> Iterator[Step]:
        number = likeliest(track) if self.number is None else self.number
        if number is None:
            raise ConfigError(f"no other part of {track.name} was found; enter the number of the other track")
        return SetNumber(number=number, first=self.first, last=self.last).steps(track)


# So many tracks that are nearest in time are compared.
MOST_LIKELY = 20


def likeliest(track: Track) -> int | None:
    """The track that is most likely another part of this one's object; None if there is none.

    Tracks of other classes, and those with a box in the same frame, are other objects. Of the rest it is the nearest in
    place and time: the distance, in lengths of the object, from where this one ends or would be if it had kept its
    motion; and the frames between, of which `MAX_GAP` count like one length.
    """
    lanes = read_lanes(track.project.store, track.recording_id)
    places = {id: place for place, id in enumerate(lanes.frames)}
    own = {places[frame.id]: stored.label for frame, stored in track.in_span() if frame.id in places}
    if not own:
        return None
    mine, near = np.array(sorted(own)), list[tuple[int, int, int, int]]()
    for number, spans in ((lane.track_id, lane.spans) for lane in lanes.lanes if lane.track_id != track.track_id):
        theirs = np.concatenate([np.arange(span[0], span[1] + 1) for span in spans])
        after = np.searchsorted(mine, theirs)
        beside = mine[np.clip([after - 1, after], 0, len(mine) - 1)]
        apart = np.abs(beside - theirs)
        row, column = divmod(int(np.argmin(apart)), len(theirs))
        if number is not None and apart[row, column] > 0:
            near.append((int(apart[row, column]), number, int(beside[row, column]), int(theirs[column])))
    near = sorted(near)[:MOST_LIKELY]
    along = track.project.labels.along(track.recording_id, tracks=[number for _, number, _, _ in near])
    others = {(each.label.track_id, each.frame_id): each.label for each in along if not is_rejected(each)}
    costs, motion = dict[int, float](), Motion(track.project, track.recording_id)
    for gap, number, here, there in near:
        label, other = own[here], others[number, lanes.frames[there]]
        if other.label == label.label:
            order = mine[mine <= here] if there > here else mine[mine >= here][::-1]
            known = order[-MOTION_BOXES:].tolist()
            before = [motion.moved(own[at].box, lanes.frames[at], lanes.frames[there]) for at in known]
            last, moved = before[-1], predicted(before, [float(place) for place in known], float(there))
            apart_m = min(float(np.linalg.norm(box.center_m - other.box.center_m)) for box in (last, moved))
            costs[number] = apart_m / float(label.box.size_m.max()) + gap / MAX_GAP
    return min(costs, key=lambda number: costs[number], default=None)


# The frames whose points tell an object's size, at most: an operator waits for them.
MOST_MEASURED = 20


class SetSize(OfSpan):
    """All boxes get one size (length, width, height), metres, as a rigid object has it; see `resized`.

    Attributes:
        size_m: None = the one that fits all of them (`common_size`), or all reviewed ones, if there are any.
    """

    do: Literal["size"] = "size"
    size_m: Size | None = None

    def fitted(self, track: Track) -> SetSize:
        """With the size that fits the boxes, and the points of their frames that can be read."""
        every = [pair for pair in track.of_frames() if pair[0].id in track.inside and not is_rejected(pair[1])]
        chosen = [pair for pair in every if pair[1].label.state in REVIEWED] or every
        if not chosen:
            raise ConfigError(_nothing(track, self, Count()))
        source, found = FrameSource(track.project), list[SizedBox]()
        for frame, stored in chosen[:: -(-len(chosen) // MOST_MEASURED)]:
            try:
                xyz_m = source.read(frame).cloud.xyz_m
            except RecordingError:  # of frames that are away, the boxes tell
                xyz_m = np.zeros((0, 3), np.float32)
            found.append(SizedBox.of(stored.label.box, xyz_m, stored.label.state in REVIEWED))
        length, width, height = (round(side, 3) for side in common_size(found).tolist())
        return self.model_copy(update={"size_m": (length, width, height)})

    def steps(self, track: Track) -> Iterator[Step]:
        assert self.size_m is not None
        boxes = {frame.id: resized(stored.label.box, self.size_m) for frame, stored in track.in_span()}
        there = track.around((track.frames[id], box) for id, box in boxes.items())

        def change(frame: StoredFrame, stored: StoredLabel) -> Sequence[Payload] | None:
            box = boxes[frame.id]
            return None if same_box(box, stored.label.box) else changed_box(there, frame, stored, box=box)

        for step in track.each(there, change):
            yield replace(step, count=step.count.model_copy(update={"size_m": self.size_m}))


def resized(box: OrientedBox, size_m: Sequence[float]) -> OrientedBox:
    """A box of another size with the same rotation and bottom, and with those of its sides that face the camera, since
    points lie on these. If the camera is between two sides, both move alike."""
    half_m, new_m = box.size_m / 2, np.asarray(size_m) / 2
    camera_m = box.rotation.T @ -box.center_m
    facing = np.where(np.abs(camera_m) > half_m, np.sign(camera_m), 0.0)
    facing[2] = -1.0
    center_m = box.center_m + box.rotation @ (facing * (half_m - new_m))
    return OrientedBox.from_parts(center_m, box.rotation, 2 * new_m)


class SetValues(OfSpan):
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

        return track.each(track.around(), change)

    def is_of_tracks(self, track: Track) -> bool:
        """Whether all values are of attributes of tracks."""
        of_tracks = {each.name for each in track.project.config.attributes if each.of is AttributeOf.TRACK}
        return self.values.keys() <= of_tracks

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


class Delete(OfSpan):
    """The boxes are removed; the object may be proposed again."""

    do: Literal["delete"] = "delete"

    def steps(self, track: Track) -> Iterator[Step]:
        for step in track.each(track.around(), lambda _, stored: [LabelDeleted(uid=stored.label.uid)]):
            yield replace(step, count=step.count.model_copy(update={"changed": 0, "deleted": step.count.changed}))


class Fill(OfSpan):
    """A box is proposed in each frame that has none and is between two boxes of the track.

    Centre, size and rotation are interpolated in the world, by the frames' times if they are recorded, else by their
    indices. With `refit`, whoever applies it then fits each box to the points of its frame (`refit_run`), which takes
    longer.
    """

    do: Literal["fill"] = "fill"
    refit: bool = False

    def steps(self, track: Track) -> Iterator[Step]:
        timeline = Timeline(track.project, track.recording_id, track.recordings)
        times = timeline.times.tolist()
        boxes = [(timeline.index[frame.id], each) for frame, each in track.boxes if frame.id in timeline.index]
        filled: list[tuple[StoredFrame, NewLabel]] = []
        for (start, before), (end, after) in pairwise(boxes):
            gap = [place for place in range(start + 1, end) if timeline.frames[place].id in track.inside]
            ends = times[start], times[end]
            for place in gap:
                # what stands still in the world does so between them
                known = timeline.moved(before.label.box, start, place), timeline.moved(after.label.box, end, place)
                (box,) = between(*known, *ends, [times[place]])
                # the values of the box that is nearer in time
                is_later = times[place] - ends[0] > ends[1] - times[place] and after.label.label == before.label.label
                values = (after if is_later else before).label.attributes
                proposal = proposal_like(before.label, box, track.track_id, attributes=values)
                filled.append((timeline.frames[place], proposal))
        there = track.around((frame, each.box) for frame, each in filled)
        for frame, each in filled:
            if frame.finalised:
                yield Step(frame, (), FINALISED)
            elif events := proposal_events(there, frame, [each]):
                gone = sum(isinstance(event, LabelDeleted) for event in events)
                yield Step(frame, events, Count(proposed=1, deleted=gone))
            else:
                yield Step(frame, (), COVERED)


Operation = SetClass | SetNumber | Merge | SetSize | SetValues | Delete | Fill | StandStill | Move
AnyOperation = Annotated[Operation, Field(discriminator="do")]

# Attempts to apply an operation to frames that change at the same time.
ATTEMPTS = 5


@dataclass(frozen=True)
class Done:
    """What an operation has done, or would do.

    Attributes:
        operation: as it was asked for, with the size that was fitted.
        action: its id.
        changes: of each changed frame, by its id.
    """

    count: Count
    operation: Operation
    action: str
    changes: tuple[tuple[int, Sequence[Payload]], ...]


def _require_moving(track: Track, operation: Operation) -> None:
    """Refuses what an object that stands still cannot have: parts, another number, and gaps."""
    if isinstance(operation, Move):
        return
    boxes, is_numbered = list(track.boxes), isinstance(operation, SetNumber)
    if isinstance(operation, SetNumber) and operation.number is not None:
        boxes += track.boxes_of(operation.number)
    if (is_numbered or isinstance(operation, Fill) or not track.is_whole) and any(each.still for _, each in boxes):
        raise ConfigError(
            f"{track.name} has one box in all frames, as an object that stands still, and keeps its number; say first "
            "that it moves (`annotator tracks moving`)"
        )


def apply(
    project: Project,
    recording_id: int,
    track_id: int,
    operation: Operation,
    author: str,
    *,
    dry_run: bool = False,
    told: Count | None = None,
    effort: Effort | None = None,
    at: int | None = None,
    recordings: OpenRecording | None = None,
) -> Done:
    """Applies an operation to a track, as one action; returns what it has done, or (`dry_run`) would do.

    Args:
        told: the count that the operator was told; nothing changes if it is another one by now.
        at: the frame in which the operator is: an undo comes back to it.

    Raises:
        ConfigError: there is nothing to do, or the count is another one; says which.
        NotFoundError: no such recording, frame, class or attribute.
    """
    if abs(track_id) > MOST_TRACK:
        raise ConfigError(f"track ids are at most {MOST_TRACK}, not {track_id:.6g}; give the id of a track")
    if isinstance(operation, SetSize) and operation.size_m is None:
        # frames are read for it, which takes too long for a transaction
        operation = operation.fitted(Track(project, recording_id, track_id, operation, recordings))
    new_track = isinstance(operation, SetNumber) and operation.number is None
    for _ in range(ATTEMPTS):
        with project.store.snapshot():
            track = Track(project, recording_id, track_id, operation, recordings)
            _require_moving(track, operation)
            steps = list(operation.steps(track))
            count = _sum([step.count for step in steps])
            if not (count.changed or count.proposed or count.deleted):
                raise ConfigError(_nothing(track, operation, count))
            if told is not None and told != count:
                raise ConfigError(f"{track.name} was changed in the meantime: this now {count.words()}; look again")
            done = Done(
                count, operation, new_action(), tuple((step.frame.id, step.events) for step in steps if step.events)
            )
            if dry_run:
                return done
            is_motion = isinstance(operation, StandStill | Move)
            changed = [step for step in steps if step.events]
            changed = changed if is_motion else sorted(changed, key=lambda step: step.frame.id != at)
            changes = [(step.frame, step.events) for step in changed]
            # what follows from another label of the track does not keep a proposal from being replaced
            first = changes[0][1][0]
            is_along = isinstance(operation, SetValues) and operation.is_of_tracks(track)
            target = first.uid if is_along and isinstance(first, LabelChanged) else None
            context = WriteContext(0, author, effort=effort, effort_target=target)
            # the object is where it was, so the 2D boxes that show it stay
            parts = (frame_parts if is_motion else partial(parts_of_frames, project))(changes, context)
        try:
            new_tracks = [count.number] if new_track and count.number else []
            if seen := [Sighting(each.sees, each.frame.id, each.frame.moment_id, True) for each in steps if each.sees]:
                project.stills.change(parts, seen, done.action)
            else:
                project.log.append_to_frames(parts, done.action, new_tracks)
        except StaleRevisionError:
            continue
        return done
    raise ConfigError(f"{track.name} is being changed by others; try again once they have finished")


def _sum(counts: Sequence[Count]) -> Count:
    given = {name: next((v for each in counts if (v := getattr(each, name)) is not None), None) for name in GIVEN}
    names = Count.model_fields.keys() - given
    return Count(**{name: sum(getattr(each, name) for each in counts) for name in names}, **given)


def _nothing(track: Track, operation: Operation, count: Count) -> str:
    if not track.boxes:
        return f"{track.name} has no boxes"
    if isinstance(operation, Fill) and not count.left():
        return f"{track.name} has no frame without a box between two of its boxes there"
    left = f" (unchanged: {count.left()})" if count.left() else ""
    return f"there is nothing to change: {track.name} has no box in these frames, or all are so already{left}"
