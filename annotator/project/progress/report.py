"""The results of the review, and the progress of the work, of one moment."""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from datetime import UTC, date, datetime
from itertools import pairwise

import numpy as np
from sqlalchemy import Connection, case, func, select

from annotator.project.audit.events import Effort
from annotator.project.database.schema import (
    BOTH_LABELS,
    events,
    frame_results,
    frames,
    image_labels,
    sightings,
    still_labels,
)
from annotator.project.jobs import Status, latest_results
from annotator.project.progress.reviewed import ORIGINS, UNTOUCHED, Action, ReviewedBox, read_log, read_reviewed
from annotator.project.recordings import removed_recordings
from annotator.types import ReviewState
from annotator.types.bases import Strict

# --- the effort per box -----------------------------------------------------------------------------------------------


class BoxEffort(Strict):
    """Mean effort per box; None where no effort was counted.

    Attributes:
        boxes: number of accepted or edited boxes with counted effort.
    """

    boxes: int
    seconds_a_box: float | None
    actions_a_box: float | None


class EffortStatistics(BoxEffort):
    """Effort per box, over all boxes and by origin; every origin is a key, even without boxes."""

    by_origin: dict[str, BoxEffort]


def _effort(boxes: Iterable[ReviewedBox]) -> BoxEffort:
    entries = [box.effort for box in boxes if box.effort is not None]
    actions, seconds = np.mean(entries, axis=0).tolist() if entries else (None, None)
    return BoxEffort(boxes=len(entries), seconds_a_box=seconds, actions_a_box=actions)


def _mean_iou(boxes: Iterable[ReviewedBox]) -> float | None:
    ious = [box.iou for box in boxes if box.iou is not None]
    return float(np.mean(ious)) if ious else None


# --- days -------------------------------------------------------------------------------------------------------------
# The page counts seconds of work for a box, from one input event to the next; looking through frames and waiting are
# not in them. So the time at work is measured between the actions in the log.

# A longer time between two actions of a person is a break.
LONGEST_PAUSE_S = 300.0


class WorkOfDay(Strict):
    """The work of one person on one day, in this computer's time zone.

    Attributes:
        boxes: labelled on this day (drawn, accepted or corrected), as far as they are still there.
        rejected: proposals.
        frames: that the person changed.
        actions, seconds: as the page counted them, for whatever became of them.
        hours: at work, breaks left out.
    """

    day: date
    person: str
    boxes: int
    rejected: int
    frames: int
    actions: int
    seconds: float
    hours: float


def seconds_at_work(actions: Sequence[Action]) -> list[float]:
    """Seconds from the person's action before to each action; after a break, what the page counted for it."""
    last_ns: dict[str, int] = {}
    seconds = []
    for action in actions:
        counted = 0.0 if action.effort is None else action.effort.seconds
        since = (action.time_ns - last_ns.get(action.author, 0)) / 1e9
        seconds.append(max(since, counted) if 0 <= since <= LONGEST_PAUSE_S else counted)
        last_ns[action.author] = action.time_ns
    return seconds


def work_by_day(
    actions: Sequence[Action], at_work_s: Sequence[float], boxes: Sequence[ReviewedBox]
) -> tuple[WorkOfDay, ...]:
    """The work of all people, in the order of days and names; `at_work_s` of each action, as from `seconds_at_work`.

    People are those who have labelled or rejected a box, or whose actions the page counted; the other authors are
    commands, such as `annotator follow`.
    """
    sums: dict[tuple[date, str], Counter[str]] = defaultdict(Counter)
    changed: dict[tuple[date, str], set[int]] = defaultdict(set)
    for action, seconds in zip(actions, at_work_s, strict=True):
        key, effort = (_day(action.time_ns), action.author), action.effort or Effort(0, 0.0)
        sums[key].update({"hours": seconds / 3600, "actions": effort.actions, "seconds": effort.seconds})
        changed[key].update(action.frames)
    for box in boxes:
        if box.decided is not None:
            person, time_ns = box.decided
            sums[_day(time_ns), person]["rejected" if box.is_rejected else "boxes"] += 1
    people = {person for (_, person), of in sums.items() if of["boxes"] or of["rejected"] or of["actions"]}
    counted = ("boxes", "rejected", "actions", "seconds", "hours")
    return tuple(
        WorkOfDay(day=day, person=person, frames=len(changed[day, person]), **{name: of[name] for name in counted})
        for (day, person), of in sorted(sums.items())
        if person in people
    )


def _day(time_ns: int) -> date:
    return datetime.fromtimestamp(time_ns / 1e9).date()


# --- pace: does the loop get faster? ----------------------------------------------------------------------------------

# Points of the curve at most, and boxes of a point at least: fewer say nothing.
MOST_GROUPS, FEWEST_BOXES = 20, 10


class PaceGroup(Strict):
    """Boxes that were labelled one after the other.

    Attributes:
        first, last: time of the first and of the last one, UTC.
        proposed, untouched: shares that were proposed, and accepted as proposed.
        iou_proposal_to_final: mean over those that were proposed; None without any.
    """

    boxes: int
    first: datetime
    last: datetime
    seconds_a_box: float
    actions_a_box: float
    proposed: float
    untouched: float
    iou_proposal_to_final: float | None


class Pace(Strict):
    """How the effort per box changed.

    Attributes:
        groups: all boxes with counted effort, in groups of equal size.
        earliest, latest: their first and last quarter; None for less than 20 boxes.
    """

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
    first, last = (datetime.fromtimestamp(_time_ns(box) / 1e9, UTC) for box in (boxes[0], boxes[-1]))
    return PaceGroup(
        **dict(_effort(boxes)),
        first=first,
        last=last,
        proposed=sum(box.was_proposed for box in boxes) / len(boxes),
        untouched=sum(box.origin == UNTOUCHED for box in boxes) / len(boxes),
        iou_proposal_to_final=_mean_iou(boxes),
    )


def _time_ns(box: ReviewedBox) -> int:
    return 0 if box.decided is None else box.decided[1]


# --- what is left -----------------------------------------------------------------------------------------------------

# Frames done last from which the rate is taken, and the parts of them whose rates give its range.
LATEST_FRAMES, PARTS, FEWEST_FRAMES = 100, 4, 10


class Interval(Strict):
    """An expected value and its range."""

    low: float
    expected: float
    high: float


class Forecast(Strict):
    """The work that is left, at the rate of the latest work.

    Attributes:
        frames_done: reviewed, labelled as empty, or finalised.
        frames_left: with open proposals, or without labels.
        frames_found_empty: in which the latest pass has found nothing; no work is expected for them.
        proposals_open: number; those of an object that stands still, in each frame that sees it.
        boxes_left: the open proposals, and as many boxes in each bare frame as in those done last; None with fewer than
            10 frames or boxes to judge by.
        boxes_an_hour: at work, breaks left out, in the frames done last, with the slowest and the fastest quarter of
            them; None as before.
        hours_left: the boxes left at these rates; None as before.
    """

    frames_done: int
    frames_left: int
    frames_found_empty: int
    proposals_open: int
    boxes_left: float | None
    boxes_an_hour: Interval | None
    hours_left: Interval | None


def _forecast(
    connection: Connection, actions: Sequence[Action], at_work_s: Sequence[float], boxes: Sequence[ReviewedBox]
) -> Forecast:
    done, bare, found_empty, proposals = _sorted_frames(connection)
    seconds: dict[int, float] = defaultdict(float)
    last_ns: dict[int, int] = {}
    for action, spent in zip(actions, at_work_s, strict=True):
        for frame_id in action.frames:
            seconds[frame_id] += spent / len(action.frames)
            last_ns[frame_id] = action.time_ns
    kept: dict[int, int] = defaultdict(int)
    for box in boxes:
        kept[box.frame_id] += box.origin is not None
    latest = sorted((id for id in last_ns if id in done), key=lambda id: last_ns[id])[-LATEST_FRAMES:]
    counts, hours = (np.array([of[id] for id in latest], np.float64) for of in (kept, seconds))
    hours /= 3600
    boxes_left = rate = hours_left = None
    if len(latest) >= FEWEST_FRAMES and counts.sum() >= FEWEST_BOXES and hours.sum() > 0:
        boxes_left = float(sum(proposals) + bare * counts.mean())
        parts = zip(*(np.array_split(values, PARTS) for values in (counts, hours)), strict=True)
        sums = [(float(count.sum()), float(spent.sum())) for count, spent in parts]
        rates = [count / spent for count, spent in sums if count and spent]
        rate = Interval(low=min(rates), expected=float(counts.sum() / hours.sum()), high=max(rates))
        hours_left = Interval(
            low=boxes_left / rate.high, expected=boxes_left / rate.expected, high=boxes_left / rate.low
        )
    return Forecast(
        frames_done=len(done),
        frames_left=bare + len(proposals),
        frames_found_empty=found_empty,
        proposals_open=sum(proposals),
        boxes_left=boxes_left,
        boxes_an_hour=rate,
        hours_left=hours_left,
    )


def _sorted_frames(connection: Connection) -> tuple[set[int], int, int, list[int]]:
    """The frames that the latest scans have found, by what is left to do.

    Returns:
        Ids of those without open proposals that are finalised, have a reviewed label, or are labelled as empty; the
        number of those that nobody and nothing has looked at; the number of those in which the latest pass has found
        nothing, and which nobody has looked at; the numbers of open proposals of the others.
    """
    by_frame = dict[int, tuple[int, int]]()
    for of in BOTH_LABELS:
        is_open = of.c.state == ReviewState.PROPOSED.value
        numbers = select(of.c.frame_id, func.sum(case((is_open, 1), else_=0)), func.count()).group_by(of.c.frame_id)
        if of is still_labels:  # a pass has nothing to propose in a finalised frame
            numbers = numbers.join(frames, frames.c.id == of.c.frame_id).where(~(is_open & frames.c.finalised))
        for frame_id, proposed, total in connection.execute(numbers):
            others = by_frame.get(frame_id, (0, 0))
            by_frame[frame_id] = others[0] + proposed, others[1] + total
    on_images = select(image_labels.c.frame_id, image_labels.c["count"])
    drawn = {row[0]: row[1] for row in connection.execute(on_images)}
    nothing = (frame_results.c.status == Status.DONE.value) & (frame_results.c.proposals == 0)
    passed = select(frame_results.c.frame_id).where(nothing & frame_results.c.id.in_(latest_results()))
    empty = set(connection.execute(passed).scalars())
    done, bare, found_empty, waiting = set[int](), 0, 0, list[int]()
    present = select(frames.c.id, frames.c.finalised).where(frames.c.position.is_not(None))
    for frame_id, finalised in connection.execute(present):
        open_proposals, total = by_frame.get(frame_id, (0, 0))
        if open_proposals:
            waiting.append(open_proposals)
        elif finalised or total or drawn.get(frame_id) == 0:
            done.add(frame_id)
        elif frame_id in empty and frame_id not in drawn:
            found_empty += 1
        else:
            bare += 1
    return done, bare, found_empty, waiting


# --- the proposals ----------------------------------------------------------------------------------------------------

# Distances from the camera, metres: from a hand in front of a camera to a car before a LiDAR.
RANGES_M = (0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 30.0, 40.0, 50.0, 70.0, 100.0)


class Quality(Strict):
    """Counts of reviewed boxes, and the quality of their proposals.

    Attributes:
        untouched, corrected, rejected: proposals.
        missed: boxes that no proposal offered.
        iou_proposal_to_final: mean exact 3D IoU of untouched and corrected proposals with what they became; None
            without any.
    """

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


class ProposalQuality(Strict):
    """Quality of the proposals; classes are those of the reviewed boxes, and distances without boxes are left out."""

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
    untouched, rejected = sum(box.origin == UNTOUCHED for box in proposed), sum(box.is_rejected for box in proposed)
    return {
        "untouched": untouched,
        "corrected": len(proposed) - untouched - rejected,
        "rejected": rejected,
        "missed": len(boxes) - len(proposed),
        "iou_proposal_to_final": _mean_iou(proposed),
    }


# --- all of it --------------------------------------------------------------------------------------------------------


class Progress(Strict):
    """The work on a project, for whoever leads it.

    Attributes:
        days: what each person did on each day, in the order of days and names.
        proposals: as they were, against what they became.
    """

    days: tuple[WorkOfDay, ...]
    pace: Pace
    proposals: ProposalQuality
    forecast: Forecast


class Review(Strict):
    """Results of the review.

    Attributes:
        accepted_untouched: share of the reviewed proposals (rejected ones included) that were accepted unchanged.
        iou_proposal_to_final: mean exact 3D IoU between the proposed and the final box, over accepted and edited
            proposals; None without any.
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
        # labels and finalised frames change with events and removed recordings, and with what is found of still
        # objects; scans change the frames, passes the results
        present = select(func.group_concat(frames.c.id)).where(frames.c.position.is_not(None))
        newest = [select(func.max(table.c.id)) for table in (events, frame_results)]
        seen = select(func.count()).select_from(sightings).where(sightings.c.seen)
        queries = (*newest, present, seen)
        key = (*(connection.execute(query).scalar() for query in queries), removed_recordings(connection))
        with self._lock:
            if self._known is None or self._known[0] != key:
                self._known = (key, _read(connection))
            return self._known[1]


def _read(connection: Connection) -> Review:
    log = read_log(connection)
    boxes, actions = read_reviewed(connection, log), list(log.actions.values())
    at_work_s = seconds_at_work(actions)
    proposals = [box for box in boxes if box.was_proposed]
    by_origin = {origin: _effort(box for box in boxes if box.origin == origin) for origin in ORIGINS}
    return Review(
        effort=EffortStatistics(**dict(_effort(box for box in boxes if box.origin is not None)), by_origin=by_origin),
        accepted_untouched=sum(box.origin == UNTOUCHED for box in proposals) / len(proposals) if proposals else None,
        iou_proposal_to_final=_mean_iou(boxes),
        progress=Progress(
            days=work_by_day(actions, at_work_s, boxes),
            pace=pace_of(boxes),
            proposals=quality_of(boxes),
            forecast=_forecast(connection, actions, at_work_s, boxes),
        ),
    )
