"""Effort per box in the order in which the boxes were labelled: does the loop get faster?"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import pairwise

import numpy as np
from pydantic import BaseModel, ConfigDict

from annotator.project.progress.action_log import UNTOUCHED, box_effort
from annotator.project.progress.reviewed import ReviewedBox

# Points of the curve at most, and boxes of a point at least: fewer say nothing.
MOST_GROUPS, FEWEST_BOXES = 20, 10


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
