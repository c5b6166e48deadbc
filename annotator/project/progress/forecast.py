"""A forecast of the hours of work that are left, from the frames that were done last.

The expected boxes of the frames that are left, times the time at work per box. The latter follows the power law of
practice, as far as the boxes that are done show it (A. Newell and P. Rosenbloom, "Mechanisms of skill acquisition and
the law of practice", 1981). How much all of it varies is measured on a few long batches of frames, since neighbours are
alike: people, scenes and days differ (B. Schmeiser, "Batch size effects in the analysis of simulation output", 1982).
`python -m benchmarks.forecast` measures how often the limits hold the truth.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, ConfigDict
from scipy.special import stdtrit

from annotator.project.progress.action_log import Action
from annotator.project.progress.days import WorkOfDay
from annotator.project.progress.frames_left import Frames
from annotator.project.progress.reviewed import ReviewedBox

FEWEST_FRAMES, FEWEST_BOXES = 10, 10
# Few and long, so that a batch holds whole scenes and turns of people.
MOST_BATCHES = 4
# Standard deviation of the exponents of practice that are expected before anything is known.
PRACTICE = 0.25
# Share of the true values that the interval is meant to hold.
COVERED = 0.8
# Days with work from which the hours a day are taken.
LATEST_DAYS = 5


class Interval(BaseModel):
    """An expected value, and limits that hold the true one in 8 of 10 cases."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    low: float
    expected: float
    high: float


class Forecast(BaseModel):
    """The work that is left.

    Attributes:
        frames_done: reviewed, labelled as empty, or finalised.
        frames_left: with open proposals, or without labels.
        frames_found_empty: in which the latest pass has found nothing; no work is expected for them.
        proposals_open: number.
        frames_used: those of the frames done that people have worked on: the forecast is made from them.
        boxes_left: that will be kept or drawn; None with fewer than 10 frames or boxes to judge by.
        hours_left: at work, breaks left out; None as before, or if few frames have nearly all boxes.
        hours_a_day: of all people together, mean of the latest five days with work; None without any.
        days_left: at that pace.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    frames_done: int
    frames_left: int
    frames_found_empty: int
    proposals_open: int
    frames_used: int
    boxes_left: float | None
    hours_left: Interval | None
    hours_a_day: float | None
    days_left: Interval | None


def forecast(
    frames: Frames,
    actions: Sequence[Action],
    at_work_s: Sequence[float],
    boxes: Sequence[ReviewedBox],
    days: Sequence[WorkOfDay],
) -> Forecast:
    """Forecasts the hours that are left.

    Args:
        at_work_s: of each action, as from `seconds_at_work`.
    """
    work = _work_of_frames(frames, actions, at_work_s, boxes)
    boxes_left, hours = None, None
    if len(work.boxes) >= FEWEST_FRAMES and work.boxes.sum() >= FEWEST_BOXES:
        left, variance = _boxes_left(work, frames)
        hours = _hours_left(work, left, variance)
        boxes_left = left
    a_day = _hours_a_day(days)
    return Forecast(
        frames_done=len(frames.done),
        frames_left=len(frames.bare) + len(frames.open_proposals),
        frames_found_empty=frames.found_empty,
        proposals_open=sum(frames.open_proposals.values()),
        frames_used=len(work.boxes),
        boxes_left=boxes_left,
        hours_left=hours,
        hours_a_day=a_day,
        days_left=None if hours is None or not a_day else _scaled(hours, 1 / a_day),
    )


class _Work(NamedTuple):
    """Of each frame that is done, in the order of the work: seconds at work, boxes, proposals."""

    seconds: Float64[np.ndarray, "n"]
    boxes: Float64[np.ndarray, "n"]
    proposals: Float64[np.ndarray, "n"]


def _work_of_frames(
    frames: Frames, actions: Sequence[Action], at_work_s: Sequence[float], boxes: Sequence[ReviewedBox]
) -> _Work:
    seconds: dict[int, float] = defaultdict(float)
    last_ns: dict[int, int] = {}
    for action, spent in zip(actions, at_work_s, strict=True):
        for frame_id in action.frames:
            seconds[frame_id] += spent / len(action.frames)
            last_ns[frame_id] = action.time_ns
    kept: dict[int, int] = defaultdict(int)
    proposed: dict[int, int] = defaultdict(int)
    for box in boxes:
        kept[box.frame_id] += box.origin is not None
        proposed[box.frame_id] += box.was_proposed
    done = sorted((id for id in last_ns if id in frames.done), key=lambda id: last_ns[id])
    return _Work(*(np.array([of[id] for id in done], np.float64) for of in (seconds, kept, proposed)))


def _boxes_left(work: _Work, frames: Frames) -> tuple[float, float]:
    """The boxes that will come from the frames that are left, and the relative variance of this number."""
    has_proposals = work.proposals > 0
    ones = np.ones(len(work.boxes))
    a_frame, of_frames = _ratio(work.boxes, ones, len(frames.bare))
    waiting = sum(frames.open_proposals.values())
    a_proposal, of_proposals = 1.0, 0.0
    if np.count_nonzero(has_proposals) >= FEWEST_FRAMES:
        a_proposal, of_proposals = _ratio(work.boxes[has_proposals], work.proposals[has_proposals], waiting)
    parts = np.array([len(frames.bare) * a_frame, waiting * a_proposal])
    total = float(parts.sum())
    if not total:
        return 0.0, 0.0
    return total, float((parts / total) ** 2 @ [of_frames, of_proposals])


def _ratio(
    numerators: Float64[np.ndarray, "n"], denominators: Float64[np.ndarray, "n"], left: int
) -> tuple[float, float]:
    """The ratio of two sums, and its relative variance in the future, where the denominators' sum is `left`."""
    batches = np.array_split(np.arange(len(numerators)), min(MOST_BATCHES, len(numerators) // 3))
    above, below = (np.array([values[batch].sum() for batch in batches]) for values in (numerators, denominators))
    ratio = float(above.sum() / below.sum())
    if not ratio or not left:
        return ratio, 0.0
    variance = float(np.var(above / below, ddof=1)) / ratio**2
    return ratio, variance * (1 / len(batches) + below.mean() / left)


def _hours_left(work: _Work, left: float, variance: float) -> Interval | None:
    """The hours for `left` boxes, a number with this relative variance; None if few frames have nearly all boxes."""
    if not left:
        return Interval(low=0.0, expected=0.0, high=0.0)
    done = np.cumsum(work.boxes)
    count = min(MOST_BATCHES, len(done) // 3, int(done[-1]) // 3)
    # with equally many boxes in each; a frame with very many may leave the next ones without
    ends = np.unique(np.searchsorted(done, np.linspace(0, done[-1], count + 1)[1:]) + 1)
    if len(ends) < 3:
        return None
    boxes = np.diff(done[ends - 1], prepend=0.0)
    paces = np.log(np.maximum(np.diff(np.cumsum(work.seconds)[ends - 1], prepend=0.0), 1.0) / boxes)
    practice = np.log(done[ends - 1] - boxes / 2)
    x, y = practice - practice.mean(), paces - paces.mean()
    slope, noise = 0.0, float(np.var(y, ddof=1))
    freedom = len(y) - 2
    of_slope = PRACTICE**2
    for _ in range(3):
        of_slope = 1 / (float(x @ x) / max(noise, 1e-6) + PRACTICE**-2)
        slope = of_slope * float(x @ y) / max(noise, 1e-6)
        noise = float(((y - slope * x) ** 2).sum()) / freedom
    ahead = float(np.log(done[-1] + left / 2) - practice.mean())
    variance += noise * (1 / len(y) + float(boxes.mean()) / left) + ahead**2 * of_slope
    expected = left * float(np.exp(paces.mean() + slope * ahead)) / 3600
    reach = float(stdtrit(freedom, (1 + COVERED) / 2)) * variance**0.5
    return Interval(low=expected * np.exp(-reach), expected=expected, high=expected * np.exp(reach))


def _hours_a_day(days: Sequence[WorkOfDay]) -> float | None:
    by_day: dict[str, float] = defaultdict(float)
    for entry in days:
        by_day[entry.day.isoformat()] += entry.hours
    latest = [by_day[day] for day in sorted(by_day)[-LATEST_DAYS:]]
    return float(np.mean(latest)) if latest else None


def _scaled(interval: Interval, factor: float) -> Interval:
    return Interval(low=interval.low * factor, expected=interval.expected * factor, high=interval.high * factor)
