"""People who walk side by side, and a follower that knows where they are: fast, and wrong where a test says so."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from annotator.project import NewLabel, Project, WriteContext
from annotator.rcv.follow_object import Followed, FollowStop
from annotator.types import Box2D, Frame, Label, OrientedBox, Proposal, Quality, ReviewState
from annotator.workflows.tracks import follow_run
from annotator.workflows.tracks.timeline import Moment, Timeline

ANN = "ann"
SIZE_M = np.array([0.6, 0.5, 1.7])
APART_M, STEP_M = 2.0, 0.1
FRAMES = 5
UNREAD = Frame.__new__(Frame)


def box_of(person: int, frame: int, off_m: float = 0.0) -> OrientedBox:
    """A person's box in a frame, or beside it."""
    return OrientedBox.from_parts(np.array([APART_M * person + STEP_M * frame + off_m, 0.0, 4.0]), np.eye(3), SIZE_M)


def proposal_of(box: OrientedBox, name: str = "person") -> Proposal:
    return Proposal(name, 0.5, box, Box2D("person", 1.0, 1.0, 9.0, 9.0), (), Quality(0.1, 0.9, 0.1))


@dataclass
class Walking:
    """Where the follower is wrong.

    Attributes:
        drift_m: by how much its box runs ahead in each frame, in the direction of following.
        lost: (person, frame) in which it does not find a person.
        taken_for: (person, frame) -> the person that it finds instead, from there on.
    """

    drift_m: float = 0.01
    lost: set[tuple[int, int]] = field(default_factory=set)
    taken_for: dict[tuple[int, int], int] = field(default_factory=dict)

    @contextmanager
    def followed(self) -> Iterator[None]:
        """Within it, the follower is the one that knows; no frame is read."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(follow_run, "Follower", lambda first, start, *_: _Knowing(self, first.index, start))
            patch.setattr(Timeline, "moment", lambda _, index: Moment(index, UNREAD, float(index)))
            yield


class _Knowing:
    def __init__(self, walking: Walking, index: int, start: OrientedBox) -> None:
        self._walking, self._start = walking, index
        self._person = round((float(start.center_m[0]) - STEP_M * index) / APART_M)

    def expected(self, moment: Moment) -> OrientedBox:
        return box_of(self._person, moment.index)

    def step(self, moment: Moment) -> Followed:
        here = (self._person, moment.index)
        if here in self._walking.lost:
            return Followed(None, FollowStop.POINTS)
        self._person = self._walking.taken_for.get(here, self._person)
        return Followed(
            proposal_of(box_of(self._person, moment.index, self._walking.drift_m * (moment.index - self._start)))
        )


def accept(project: Project, index: int, *people: tuple[int, int | None] | int, author: str = ANN) -> tuple[str, ...]:
    """Accepts the boxes of people, each with or without a track, in a frame."""
    frame = project.frames.of()[index]
    pairs: list[Any] = [each if isinstance(each, tuple) else (each, None) for each in people]
    new = [NewLabel("person", box_of(person, index), track_id=track) for person, track in pairs]
    return project.labels.create(frame.id, new, WriteContext(frame.revision, author)).uids


def labels_of(project: Project, index: int) -> list[Label]:
    return list(project.labels.of_frame(project.frames.of()[index].id))


def tracks_of(project: Project) -> list[str]:
    """The labels of each frame in the order of their places: "1" reviewed, "1?" proposed, "-" without a track."""
    return [
        " ".join(
            f"{'-' if label.track_id is None else label.track_id}{'?' * (label.state is ReviewState.PROPOSED)}"
            for label in sorted(labels_of(project, index), key=lambda label: float(label.box.center_m[0]))
            if label.state is not ReviewState.REJECTED
        )
        for index in range(len(project.frames.of()))
    ]
