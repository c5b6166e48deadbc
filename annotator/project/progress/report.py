"""The results of the review, and the progress of the work, of one moment."""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict
from sqlalchemy import Connection, func, select

from annotator.project.database.schema import events, frame_results, frames
from annotator.project.progress.action_log import UNTOUCHED, EffortStatistics, effort_of, read_log
from annotator.project.progress.days import WorkOfDay, seconds_at_work, work_by_day
from annotator.project.progress.pace import Forecast, Pace, forecast, pace_of, read_frames
from annotator.project.progress.reviewed import ReviewedBox, read_reviewed
from annotator.project.recordings import removed_recordings

# Distances from the camera, metres: from a hand in front of a camera to a car before a LiDAR.
RANGES_M = (0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 30.0, 40.0, 50.0, 70.0, 100.0)


class Quality(BaseModel):
    """Counts of reviewed boxes, and the quality of their proposals.

    Attributes:
        untouched, corrected, rejected: proposals.
        missed: boxes that no proposal offered.
        iou_proposal_to_final: mean exact 3D IoU of untouched and corrected proposals with what they became; None
            without any.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    untouched: int
    corrected: int
    rejected: int
    missed: int
    iou_proposal_to_final: float | None


class RangeQuality(Quality):
    """Quality from one distance to the next.

    Attributes:
        from_m, to_m: distance of the boxes' centres from the camera; None = any greater one.
    """

    from_m: float
    to_m: float | None


class ProposalQuality(BaseModel):
    """Quality of the proposals; classes are those of the reviewed boxes, and distances without boxes are left out."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    by_class: dict[str, Quality]
    by_range: tuple[RangeQuality, ...]
    by_class_and_range: dict[str, tuple[RangeQuality, ...]]


def quality_of(boxes: Sequence[ReviewedBox]) -> ProposalQuality:
    """The quality of the proposals of all reviewed boxes, those without a review (unchanged imports) left out."""
    by_class: dict[str, list[ReviewedBox]] = defaultdict(list)
    for box in boxes:
        if box.was_proposed or box.origin is not None:
            by_class[box.label].append(box)
    classes = sorted(by_class)
    return ProposalQuality(
        by_class={name: Quality(**_numbers(by_class[name])) for name in classes},
        by_range=_by_range(box for name in classes for box in by_class[name]),
        by_class_and_range={name: _by_range(by_class[name]) for name in classes},
    )


def _by_range(boxes: Iterable[ReviewedBox]) -> tuple[RangeQuality, ...]:
    found: dict[int, list[ReviewedBox]] = defaultdict(list)
    for box in boxes:
        found[bisect_right(RANGES_M, box.range_m) - 1].append(box)
    ends = (*RANGES_M[1:], None)
    return tuple(RangeQuality(from_m=RANGES_M[n], to_m=ends[n], **_numbers(found[n])) for n in sorted(found))


def _numbers(boxes: Sequence[ReviewedBox]) -> dict[str, int | float | None]:
    proposed = [box for box in boxes if box.was_proposed]
    kept = [box for box in proposed if not box.is_rejected]
    untouched = sum(box.origin == UNTOUCHED for box in kept)
    ious = [box.iou for box in kept if box.iou is not None]
    return {
        "untouched": untouched,
        "corrected": len(kept) - untouched,
        "rejected": len(proposed) - len(kept),
        "missed": len(boxes) - len(proposed),
        "iou_proposal_to_final": float(np.mean(ious)) if ious else None,
    }


class Progress(BaseModel):
    """The work on a project, for whoever leads it.

    Attributes:
        days: what each person did on each day, in the order of days and names.
        pace: effort per box in the order in which the boxes were labelled.
        proposals: as they were, against what they became.
        forecast: of the work that is left.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    days: tuple[WorkOfDay, ...]
    pace: Pace
    proposals: ProposalQuality
    forecast: Forecast


@dataclass(frozen=True)
class Review:
    """Results of the review.

    Attributes:
        effort: cost per box.
        accepted_untouched: share of the reviewed proposals (rejected ones included) that were accepted unchanged.
        iou_proposal_to_final: mean exact 3D IoU between the proposed and the final box, over accepted and edited
            proposals; None without any.
        progress: of the work.
    """

    effort: EffortStatistics
    accepted_untouched: float | None
    iou_proposal_to_final: float | None
    progress: Progress


class ReviewReader:
    """Computes the results of the review, and keeps them until what they depend on has changed. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: tuple[tuple[object, ...], Review] | None = None

    def read(self, connection: Connection) -> Review:
        """The results of the transaction's moment."""
        # labels and finalised frames change with events and removed recordings; scans change the frames, passes the
        # results
        present = select(func.group_concat(frames.c.id)).where(frames.c.position.is_not(None))
        newest = [select(func.max(table.c.id)) for table in (events, frame_results)]
        key = (*(connection.execute(query).scalar() for query in (*newest, present)), removed_recordings(connection))
        with self._lock:
            if self._known is None or self._known[0] != key:
                self._known = (key, _read(connection))
            return self._known[1]


def _read(connection: Connection) -> Review:
    log = read_log(connection)
    boxes = read_reviewed(connection, log)
    proposals = [box for box in boxes if box.was_proposed]
    untouched = sum(box.origin == UNTOUCHED for box in proposals)
    ious = [box.iou for box in boxes if box.iou is not None]
    actions = list(log.actions.values())
    at_work_s = seconds_at_work(actions)
    days = work_by_day(actions, at_work_s, boxes)
    return Review(
        effort_of([(box.origin, box.effort) for box in boxes if box.origin is not None and box.effort is not None]),
        untouched / len(proposals) if proposals else None,
        float(np.mean(ious)) if ious else None,
        Progress(
            days=days,
            pace=pace_of(boxes),
            proposals=quality_of(boxes),
            forecast=forecast(read_frames(connection), actions, at_work_s, boxes),
        ),
    )
