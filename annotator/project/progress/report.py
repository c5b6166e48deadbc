"""The results of the review, and the progress of the work, of one moment."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict
from sqlalchemy import Connection, func, select

from annotator.project.database.schema import events, frame_results, frames
from annotator.project.progress.action_log import UNTOUCHED, EffortStatistics, effort_of, read_log
from annotator.project.progress.days import WorkOfDay, seconds_at_work, work_by_day
from annotator.project.progress.frames_left import read_frames
from annotator.project.progress.pace import Forecast, Pace, forecast, pace_of
from annotator.project.progress.quality import ProposalQuality, quality_of
from annotator.project.progress.reviewed import read_reviewed
from annotator.project.recordings import removed_recordings


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
