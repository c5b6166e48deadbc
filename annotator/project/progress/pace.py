"""Effort per box in the order in which the boxes were labelled (does the loop get faster?), and what is left."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise

import numpy as np
from pydantic import BaseModel, ConfigDict
from sqlalchemy import Connection, case, func, select

from annotator.project.database.schema import frame_results, frames, image_labels, labels
from annotator.project.jobs import Status, latest_results
from annotator.project.progress.action_log import UNTOUCHED, Action, box_effort
from annotator.project.progress.reviewed import ReviewedBox
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


# Points of the curve at most, and boxes of a point at least: fewer say nothing.
MOST_GROUPS, FEWEST_BOXES = 20, 10
# Frames done last from which the rate is taken, and the parts of them whose rates give its range.
LATEST_FRAMES, PARTS, FEWEST_FRAMES = 100, 4, 10


class PaceGroup(BaseModel):
    """Boxes that were labelled one after the other.

    Attributes:
        boxes: their number.
        first, last: time of the first and of the last one, UTC.
        seconds_a_box, actions_a_box: mean effort.
        proposed: share that was proposed.
        untouched: share that was accepted as proposed.
        iou_proposal_to_final: mean over those that were proposed; None without any.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    boxes: int
    first: datetime
    last: datetime
    seconds_a_box: float
    actions_a_box: float
    proposed: float
    untouched: float
    iou_proposal_to_final: float | None


class Pace(BaseModel):
    """How the effort per box changed.

    Attributes:
        groups: all boxes with counted effort, in groups of equal size.
        earliest, latest: their first and last quarter; None for less than 20 boxes.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    groups: tuple[PaceGroup, ...]
    earliest: PaceGroup | None
    latest: PaceGroup | None


class Interval(BaseModel):
    """An expected value and its range."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    low: float
    expected: float
    high: float


class Forecast(BaseModel):
    """The work that is left, at the rate of the latest work.

    Attributes:
        frames_done: reviewed, labelled as empty, or finalised.
        frames_left: with open proposals, or without labels.
        frames_found_empty: in which the latest pass has found nothing; no work is expected for them.
        proposals_open: number.
        boxes_left: the open proposals, and as many boxes in each bare frame as in those done last; None with fewer than
            10 frames or boxes to judge by.
        boxes_an_hour: at work, breaks left out, in the frames done last, with the slowest and the fastest quarter of
            them; None as before.
        hours_left: the boxes left at these rates; None as before.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    frames_done: int
    frames_left: int
    frames_found_empty: int
    proposals_open: int
    boxes_left: float | None
    boxes_an_hour: Interval | None
    hours_left: Interval | None


def pace_of(boxes: Sequence[ReviewedBox]) -> Pace:
    """The pace of all accepted and edited boxes with counted effort."""
    done = [box for box in boxes if box.decided is not None and box.effort is not None and not box.is_rejected]
    done.sort(key=_time_ns)
    if not done:
        return Pace(groups=(), earliest=None, latest=None)
    count = min(max(len(done) // FEWEST_BOXES, 1), MOST_GROUPS)
    edges = np.linspace(0, len(done), count + 1).round().astype(int).tolist()
    groups = tuple(_group(done[a:b]) for a, b in pairwise(edges))
    quarter = len(done) // 4 if len(done) >= 2 * FEWEST_BOXES else 0
    return Pace(
        groups=groups,
        earliest=_group(done[:quarter]) if quarter else None,
        latest=_group(done[-quarter:]) if quarter else None,
    )


def forecast(
    frames: Frames, actions: Sequence[Action], at_work_s: Sequence[float], boxes: Sequence[ReviewedBox]
) -> Forecast:
    """The work left; `at_work_s` of each action, as from `seconds_at_work`."""
    seconds: dict[int, float] = defaultdict(float)
    last_ns: dict[int, int] = {}
    for action, spent in zip(actions, at_work_s, strict=True):
        for frame_id in action.frames:
            seconds[frame_id] += spent / len(action.frames)
            last_ns[frame_id] = action.time_ns
    kept: dict[int, int] = defaultdict(int)
    for box in boxes:
        kept[box.frame_id] += box.origin is not None
    latest = sorted((id for id in last_ns if id in frames.done), key=lambda id: last_ns[id])[-LATEST_FRAMES:]
    done, hours = (np.array([of[id] for id in latest], np.float64) for of in (kept, seconds))
    hours /= 3600
    proposals = sum(frames.open_proposals.values())
    boxes_left = rate = hours_left = None
    if len(latest) >= FEWEST_FRAMES and done.sum() >= FEWEST_BOXES and hours.sum() > 0:
        boxes_left = float(proposals + len(frames.bare) * done.mean())
        parts = [
            (float(done[part].sum()), float(hours[part].sum()))
            for part in np.array_split(np.arange(len(latest)), PARTS)
        ]
        rates = [count / spent for count, spent in parts if count and spent]
        rate = Interval(low=min(rates), expected=float(done.sum() / hours.sum()), high=max(rates))
        hours_left = Interval(
            low=boxes_left / rate.high, expected=boxes_left / rate.expected, high=boxes_left / rate.low
        )
    return Forecast(
        frames_done=len(frames.done),
        frames_left=len(frames.bare) + len(frames.open_proposals),
        frames_found_empty=frames.found_empty,
        proposals_open=proposals,
        boxes_left=boxes_left,
        boxes_an_hour=rate,
        hours_left=hours_left,
    )


def _group(boxes: Sequence[ReviewedBox]) -> PaceGroup:
    effort = box_effort([box.effort for box in boxes if box.effort is not None])
    ious = [box.iou for box in boxes if box.iou is not None]
    first, last = (datetime.fromtimestamp(_time_ns(box) / 1e9, UTC) for box in (boxes[0], boxes[-1]))
    return PaceGroup(
        **effort.model_dump(),
        first=first,
        last=last,
        proposed=sum(box.was_proposed for box in boxes) / len(boxes),
        untouched=sum(box.origin == UNTOUCHED for box in boxes) / len(boxes),
        iou_proposal_to_final=float(np.mean(ious)) if ious else None,
    )


def _time_ns(box: ReviewedBox) -> int:
    return 0 if box.decided is None else box.decided[1]
