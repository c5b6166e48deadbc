"""A project that several people have worked on for several days, written as events with a clock of its own.

A pass has proposed boxes in all frames, the later ones better, as after more training. People take the frames in turn
and review them: accept, correct, reject, draw what is missing. Each has a pace of their own, and gets faster.
"""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from sqlalchemy import Connection

from annotator.project import Effort, Origin, Project, WriteContext, create_project
from annotator.project.changes import LabelChanged, NewLabel, Payload, ProposalsReplaced
from annotator.project.jobs import record_result
from annotator.project.log import Writer
from annotator.project.records import BoxRecord
from annotator.types import Box2D, OrientedBox, Proposal, Quality, ReviewState, Source

# class -> its share, and the size of its boxes in metres
CLASSES = {"car": (0.6, (4.2, 1.6, 1.8)), "pedestrian": (0.3, (0.7, 1.7, 0.6)), "cyclist": (0.1, (1.8, 1.7, 0.7))}
DAY_S = 86_400.0
# a Monday, 09:00 UTC
BEGIN_S = 1_767_603_600.0


@dataclass(frozen=True)
class Work:
    """What is worked, and by whom.

    Attributes:
        frames: of the recording.
        reviewed: the number of its frames that people have reviewed.
        objects: mean number of objects of a frame.
        people: name -> seconds that they need, relative to the others.
        days: working days over which the reviewed frames are spread.
        learning: seconds for a box at the end, relative to the beginning.
    """

    frames: int = 400
    reviewed: int = 300
    objects: float = 3.0
    people: dict[str, float] = field(default_factory=lambda: {"ann": 1.0, "bob": 1.4, "eve": 0.8})
    days: int = 5
    learning: float = 0.5
    seed: int = 0


class _Clock:
    """Seconds since the epoch, set by whoever works."""

    def __init__(self) -> None:
        self.now_s = BEGIN_S - DAY_S

    def __call__(self) -> int:
        return int(self.now_s * 1e9)


def worked_project(root: Path, name: str, work: Work) -> Project:
    """Creates the project `root/name`; its recording has no files."""
    clock, random = _Clock(), np.random.default_rng(work.seed)
    project = create_project(root, name, tuple(CLASSES), clock=clock)
    keys = [f"{n:06d}" for n in range(work.frames)]
    project.recordings.add(root / "drive", "rgbd", "drive", keys, True)
    ids = [frame.id for frame in project.frames.of()]
    run = project.jobs.start(image_detector="a", view_detector="b", config_json="{}").id
    writer = Writer(project.store)
    with project.store.write() as connection:
        scenes = [_proposed(connection, writer, id, run, n / work.frames, work, random) for n, id in enumerate(ids)]
        people = tuple(work.people)
        free_s = dict.fromkeys(people, 0.0)
        a_day = -(-work.reviewed // work.days)
        for n in range(work.reviewed):
            day, person = n // a_day, people[n % len(people)]
            clock.now_s = max(free_s[person], BEGIN_S + day * DAY_S)
            pace = work.people[person] * (1 - (1 - work.learning) * n / max(work.reviewed, 1))
            _review(connection, writer, ids[n], scenes[n], person, pace, clock, random)
            free_s[person] = clock.now_s
    return project


@dataclass(frozen=True, eq=False)
class _Object:
    """An object of a frame.

    Attributes:
        label: its class.
        truth: its box.
        uid: of its proposal; None if it was missed.
        is_wrong: whether there is only a proposal, and no object.
        is_good: whether the proposal is its box.
    """

    label: str
    truth: OrientedBox
    uid: str | None
    is_wrong: bool
    is_good: bool


def _proposed(
    connection: Connection,
    writer: Writer,
    frame_id: int,
    run: int,
    progress: float,
    work: Work,
    random: np.random.Generator,
) -> list[_Object]:
    """Proposes the boxes of a frame; returns its objects."""
    objects, proposed = [], list[NewLabel]()
    shares = [share for share, _ in CLASSES.values()]
    for _ in range(random.poisson(work.objects)):
        label = str(random.choice(list(CLASSES), p=shares))
        range_m = float(np.clip(random.lognormal(2.9, 0.6), 3.0, 90.0))
        truth = _box(label, range_m, random)
        chance = random.random()
        error = (0.02 + 0.004 * range_m) * (1.3 - progress)
        is_good = bool(random.random() > 4 * error)
        uid = None if chance < 0.1 else uuid.uuid4().hex
        if uid is not None:
            box = truth if is_good else _moved(truth, random, error)
            image_box = Box2D(label, 1.0, 2.0, 30.0, 40.0, 0.8)
            proposal = Proposal(label, 0.8, box, image_box, (), Quality(0.1, 0.9, 0.01, 0.8))
            proposed.append(NewLabel(label, box, state=ReviewState.PROPOSED, proposal=proposal, uid=uid))
        objects.append(_Object(label, truth, uid, chance > 0.92, is_good))
    count = len(proposed)
    record_result(connection, run, frame_id, 0.1, time_ns=writer.store.clock(), proposals=count)
    replaced = ProposalsReplaced([each.proposal for each in proposed if each.proposal], proposed, run)
    writer.to_frame_in(connection, frame_id, [replaced], WriteContext(0, "rcv", Source.AUTO))
    return objects


def _box(label: str, range_m: float, random: np.random.Generator) -> OrientedBox:
    angle, turn = random.uniform(-0.6, 0.6), random.uniform(-np.pi, np.pi)
    center = np.array([range_m * np.sin(angle), 1.0, range_m * np.cos(angle)])
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return OrientedBox.from_parts(center, rotation, np.array(CLASSES[label][1]))


def _moved(box: OrientedBox, random: np.random.Generator, error: float) -> OrientedBox:
    shift, stretch = random.normal(0, error, 3), np.exp(random.normal(0, error, 3))
    return OrientedBox.from_parts(box.center_m + shift * box.size_m, box.rotation, box.size_m * stretch)


def _review(
    connection: Connection,
    writer: Writer,
    frame_id: int,
    objects: Sequence[_Object],
    person: str,
    pace: float,
    clock: _Clock,
    random: np.random.Generator,
) -> None:
    """One frame: a look at it, then one action for each object."""
    revision = 1
    clock.now_s += 3.0 * pace
    for item in objects:
        payload, actions, seconds = _decision(item)
        spent = seconds * pace * float(random.lognormal(0.0, 0.4))
        clock.now_s += spent + 0.5
        context = WriteContext(revision, person, effort=Effort(actions, spent))
        revision = writer.to_frame_in(connection, frame_id, [payload], context).revision


def _decision(item: _Object) -> tuple[Payload, int, float]:
    """What is done with an object, in how many actions and seconds."""
    if item.uid is None:
        return NewLabel(item.label, item.truth, origin=Origin.DRAWN), 6, 20.0
    if item.is_wrong:
        return LabelChanged(uid=item.uid, state=ReviewState.REJECTED), 1, 2.0
    if item.is_good:
        return LabelChanged(uid=item.uid, state=ReviewState.ACCEPTED), 1, 2.0
    return LabelChanged(state=ReviewState.EDITED, uid=item.uid, label=item.label, box=BoxRecord.of(item.truth)), 3, 9.0
