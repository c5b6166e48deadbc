"""The lanes of a recording's timeline: where its tracks have boxes, and which of them are reviewed.

A recording may have 5,000 frames and 300 tracks: 147,000 boxes take 0.35 s.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby

from sqlalchemy import Integer, case, cast, func, select

from annotator.project.database.schema import frames, labels, recordings, stills
from annotator.project.database.store import Store
from annotator.project.labels import REVIEWED
from annotator.project.review import label_doubt
from annotator.project.rows import Terms
from annotator.types import ReviewState

LEVELS = 5
"""Levels of the doubt of proposals: 1 is 0 or unknown, 5 is 1."""

Span = tuple[int, int, str | None, int]
"""First and last place, class, and 0 if its boxes are reviewed, else the level of their doubt."""


@dataclass(frozen=True)
class Lane:
    """The boxes of one track.

    Attributes:
        track_id: None for the boxes without a track, whose spans have no class; of several boxes in a frame, the one
            with the most doubt counts.
        spans: in order; between them, the track has no box. Rejected boxes are left out.
        still: it stands still.
    """

    track_id: int | None
    spans: tuple[Span, ...]
    still: bool = False


@dataclass(frozen=True)
class Lanes:
    """What a recording's timeline shows.

    Attributes:
        frames: ids of the frames that the latest scan has found, in order. A *place* is an index of this list.
        lanes: one for each track of the recording's moments, in the order of their beginnings; boxes without a track
            come last.
    """

    frames: tuple[int, ...]
    lanes: tuple[Lane, ...]


def read_lanes(store: Store, recording_id: int) -> Lanes:
    """Reads the lanes of a recording."""
    present = (frames.c.recording_id == recording_id) & frames.c.position.is_not(None)
    level = case(
        (labels.c.state.in_([state.value for state in REVIEWED]), 0),
        else_=1 + cast(func.round((LEVELS - 1) * func.coalesce(label_doubt(labels), 0.0)), Integer),
    )
    boxes = (
        select(labels.c.track_id, frames.c.id, labels.c.class_id, level.label("level"), frames.c.position)
        .join(frames, frames.c.moment_id == labels.c.moment_id)
        .where(present, labels.c.state != ReviewState.REJECTED.value)
        .order_by(labels.c.track_id, frames.c.position, "level")
    )
    with store.read() as connection:
        names = Terms(connection).names
        found = connection.execute(select(frames.c.id).where(present).order_by(frames.c.position)).scalars().all()
        rows = connection.execute(boxes).all()
        rig = select(recordings.c.rig_id).where(recordings.c.id == recording_id).scalar_subquery()
        is_there = stills.c.state != ReviewState.REJECTED.value
        still = set(connection.execute(select(stills.c.track_id).where(stills.c.rig_id == rig, is_there)).scalars())
    places = {frame_id: place for place, frame_id in enumerate(found)}
    lanes = []
    for track_id, group in groupby(rows, key=lambda row: row[0]):
        # of several in a frame, the last one
        at = {
            places[frame]: (None if track_id is None else names[class_id], level)
            for _, frame, class_id, level, _ in group
        }
        lanes.append(Lane(track_id, tuple(_spans(at.items())), track_id in still))
    lanes.sort(key=lambda lane: (lane.track_id is None, lane.spans[0][0]))
    return Lanes(tuple(found), tuple(lanes))


def _spans(boxes: Iterable[tuple[int, tuple[str | None, int]]]) -> Iterator[Span]:
    """Returns the spans of boxes that are alike: place, and class and level; by place."""
    first, last = -1, -2
    like: tuple[str | None, int] = None, 0
    for place, each in boxes:
        if place != last + 1 or each != like:
            if last >= 0:
                yield first, last, *like
            first, like = place, each
        last = place
    if last >= 0:
        yield first, last, *like
