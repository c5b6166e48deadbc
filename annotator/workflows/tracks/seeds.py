"""Where the objects of a frame were in the frame before it: what the recursion starts from."""

from __future__ import annotations

from collections.abc import Sequence

from annotator.project import REVIEWED, Project, StoredFrame
from annotator.project.overview import neighbours
from annotator.rcv.seeds import Seed
from annotator.tracking.config import TrackingConfig
from annotator.tracking.link import Seen, link
from annotator.types import Label, Proposal


def seeds_of(project: Project, frame: StoredFrame) -> tuple[Seed, ...]:
    """The reviewed boxes of the frame before in the same recording, in the order of its labels.

    Returns:
        none where there is no frame before, nobody has reviewed it, or the frames do not follow each other in time.
    """
    return tuple(Seed(label.label, label.box) for label in reviewed_before(project, frame))


def reviewed_before(project: Project, frame: StoredFrame) -> tuple[Label, ...]:
    """The labels that `seeds_of` makes its seeds from, in the same order."""
    if not project.recordings.get(frame.recording_id).is_sequence:
        return ()
    before = neighbours(project, frame)[0]
    if before is None:
        return ()
    return tuple(label for label in project.labels.of_frame(before) if label.state in REVIEWED)


def followed_tracks(project: Project, frame: StoredFrame, found: Sequence[Proposal]) -> list[int | None]:
    """For each proposal of a frame the track of the reviewed box before that is its object, where there is one."""
    tracked = [label for label in reviewed_before(project, frame) if label.track_id is not None]
    ids: list[int | None] = [None] * len(found)
    for label, place in zip(tracked, owners(tracked, found), strict=True):
        if place is not None:
            ids[place] = label.track_id
    return ids


def owners(labels: Sequence[Label], found: Sequence[Proposal]) -> list[int | None]:
    """For each label of a frame the place of the proposal that is its object in the next frame, or None."""
    frames = [[Seen(label.label, label.box) for label in labels], [Seen(each.label, each.box) for each in found]]
    places: list[int | None] = [None] * len(labels)
    for track in link(frames, [0.0, 1.0], TrackingConfig()):
        if len(track.members) == 2:
            (_, number), (_, place) = track.members
            places[number] = place
    return places
