"""What each person did on each day, and how long they were at work.

The page counts seconds of work for a box, from one input event to the next; looking through frames and waiting are not
in them. So the time at work is measured between the actions in the log.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date, datetime
from functools import lru_cache

from pydantic import BaseModel, ConfigDict

from annotator.project.progress.action_log import Action
from annotator.project.progress.reviewed import ReviewedBox

# A longer time between two actions of a person is a break.
LONGEST_PAUSE_S = 300.0


class WorkOfDay(BaseModel):
    """The work of one person on one day, in this computer's time zone.

    Attributes:
        boxes: labelled on this day (drawn, accepted or corrected), as far as they are still there.
        rejected: proposals.
        frames: that the person changed.
        actions, seconds: as the page counted them, for whatever became of them.
        hours: at work, breaks left out.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

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
    """The work of all people, in the order of days and names.

    People are those who have labelled or rejected a box, or whose actions the page counted; the other authors are
    commands, such as `annotator follow`.

    Args:
        at_work_s: of each action, as from `seconds_at_work`.
    """
    found: dict[tuple[date, str], _Sums] = {}
    for action, seconds in zip(actions, at_work_s, strict=True):
        sums = found.setdefault((_day(action.time_ns), action.author), _Sums())
        sums.at_work_s += seconds
        sums.frames.update(action.frames)
        if action.effort is not None:
            sums.actions += action.effort.actions
            sums.seconds += action.effort.seconds
    for box in boxes:
        if box.decided is not None:
            person, time_ns = box.decided
            sums = found.setdefault((_day(time_ns), person), _Sums())
            sums.rejected += box.is_rejected
            sums.boxes += not box.is_rejected
    people = {person for (_, person), sums in found.items() if sums.boxes or sums.rejected or sums.actions}
    return tuple(
        WorkOfDay(
            day=day,
            person=person,
            boxes=sums.boxes,
            rejected=sums.rejected,
            frames=len(sums.frames),
            actions=sums.actions,
            seconds=sums.seconds,
            hours=sums.at_work_s / 3600,
        )
        for (day, person), sums in sorted(found.items(), key=lambda entry: entry[0])
        if person in people
    )


class _Sums:
    """Sums over one day of one person."""

    def __init__(self) -> None:
        self.boxes = self.rejected = self.actions = 0
        self.seconds = self.at_work_s = 0.0
        self.frames: set[int] = set()


def _day(time_ns: int) -> date:
    return _day_of_quarter(time_ns // (900 * 10**9))


@lru_cache(maxsize=4096)
def _day_of_quarter(quarter: int) -> date:
    """The day of a quarter of an hour since the epoch; in every time zone, a day begins with one."""
    return datetime.fromtimestamp(900 * quarter).date()
