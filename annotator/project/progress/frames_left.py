"""Which frames are done, and what waits in the others."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, case, func, select

from annotator.project.database.schema import frame_results, frames, image_labels, labels
from annotator.project.jobs import Status, latest_results
from annotator.types import ReviewState


@dataclass(frozen=True)
class Frames:
    """The frames that the latest scans have found.

    Attributes:
        done: ids of those without open proposals that are finalised, have a reviewed label, or are labelled as empty.
        bare: ids of those that nobody and nothing has looked at.
        open_proposals: number in each frame that has some.
        found_empty: number of those in which the latest pass has found nothing, and which nobody has looked at.
    """

    done: frozenset[int]
    bare: frozenset[int]
    open_proposals: dict[int, int]
    found_empty: int


def read_frames(connection: Connection) -> Frames:
    """Sorts the frames by what is left to do."""
    is_open = labels.c.state == ReviewState.PROPOSED.value
    counts = select(labels.c.frame_id, func.sum(case((is_open, 1), else_=0)), func.count()).group_by(labels.c.frame_id)
    by_frame = {frame_id: (waiting, total) for frame_id, waiting, total in connection.execute(counts)}
    on_images = select(image_labels.c.frame_id, image_labels.c["count"])
    drawn = {row[0]: row[1] for row in connection.execute(on_images)}
    nothing = (frame_results.c.status == Status.DONE.value) & (frame_results.c.proposals == 0)
    passed = select(frame_results.c.frame_id).where(nothing & frame_results.c.id.in_(latest_results()))
    empty = set(connection.execute(passed).scalars())
    done, bare, waiting, found_empty = set(), set(), dict[int, int](), 0
    present = select(frames.c.id, frames.c.finalised).where(frames.c.position.is_not(None))
    for frame_id, finalised in connection.execute(present):
        open_proposals, total = by_frame.get(frame_id, (0, 0))
        if open_proposals:
            waiting[frame_id] = open_proposals
        elif finalised or total or drawn.get(frame_id) == 0:
            done.add(frame_id)
        elif frame_id in empty and frame_id not in drawn:
            found_empty += 1
        else:
            bare.add(frame_id)
    return Frames(frozenset(done), frozenset(bare), waiting, found_empty)
