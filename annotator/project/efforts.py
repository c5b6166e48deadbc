"""What labels cost their operators, and what became of proposals: read from the events of actions."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby

from sqlalchemy import Connection, select

from annotator.project.events import Effort
from annotator.project.payloads import ImageBoxesState, LabelState
from annotator.project.schema import AnyRow, events, revertible
from annotator.project.subjects import IMAGE, LABEL
from annotator.types import Box2D, ReviewState

DRAFT = "draft-"
PROPOSED_JSON = f'"state":"{ReviewState.PROPOSED.value}"'


@dataclass(frozen=True)
class ActionCost:
    """One action that somebody counted: what it cost, and the labels or begun objects that it was for."""

    effort: Effort
    subjects: tuple[str, ...]


@dataclass(frozen=True)
class Efforts:
    """What the log says about effort.

    Attributes:
        actions: that were counted, in order.
        became: begun object -> the label that it became.
        moved: begun object -> its id once its box on the image was changed.
        proposed: label -> what it was as a proposal, where an operator has touched it.
    """

    actions: tuple[ActionCost, ...]
    became: Mapping[str, str]
    moved: Mapping[str, str]
    proposed: Mapping[str, LabelState]

    def by_label(self) -> dict[str, tuple[float, float]]:
        """The actions and seconds that went into each label; an action for several is shared among them."""
        spent: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
        for action in self.actions:
            for subject in action.subjects:
                entry = spent[self._label(subject)]
                entry[0] += action.effort.actions / len(action.subjects)
                entry[1] += action.effort.seconds / len(action.subjects)
        return {uid: (actions, seconds) for uid, (actions, seconds) in spent.items()}

    def _label(self, subject: str) -> str:
        seen = set()
        while subject not in self.became and subject in self.moved and subject not in seen:
            seen.add(subject)
            subject = self.moved[subject]
        return self.became.get(subject, subject)


def draft_id(frame_id: int, image_box: Box2D) -> str:
    """The name of an object that is begun but has no label yet; effort goes to it until it has."""
    edges = ",".join(f"{edge:.3f}" for edge in image_box.xyxy)
    return DRAFT + hashlib.sha256(f"{frame_id}:{edges}".encode()).hexdigest()[:20]


def read_efforts(connection: Connection) -> Efforts:
    """What all actions so far have cost, and for what."""
    query = (
        select(
            events.c.frame_id,
            events.c.kind,
            events.c.action,
            events.c.subject.label("told"),
            events.c.actions,
            events.c.seconds,
            revertible.c.subject,
            revertible.c.before,
            revertible.c.after,
        )
        .join(revertible, revertible.c.event_id == events.c.id)
        .order_by(events.c.id)
    )
    found = _Found()
    for _, rows in groupby(connection.execute(query), key=lambda row: row.action):
        found.take(list(rows))
    return Efforts(tuple(found.actions), found.became, found.moved, found.proposed)


@dataclass
class _Found:
    actions: list[ActionCost] = field(default_factory=list)
    became: dict[str, str] = field(default_factory=dict)
    moved: dict[str, str] = field(default_factory=dict)
    proposed: dict[str, LabelState] = field(default_factory=dict)

    def take(self, rows: Sequence[AnyRow]) -> None:
        """The events of one action."""
        touched = dict.fromkeys(_uid(row) for row in rows if row.subject.startswith(LABEL))
        for row in rows:
            if row.subject == IMAGE:
                self._follow(row)
            elif row.subject.startswith(LABEL):
                self._remember(row)
        first = rows[0]
        if first.actions is not None:
            subjects = (first.told,) if first.told is not None else tuple(touched)
            self.actions.append(ActionCost(Effort(first.actions, first.seconds), subjects))

    def _follow(self, row: AnyRow) -> None:
        """A box on the image that was changed goes on under another name."""
        if row.before is None or row.after is None:
            return
        before, after = (ImageBoxesState.model_validate_json(state).boxes for state in (row.before, row.after))
        gone, new = [box for box in before if box not in after], [box for box in after if box not in before]
        if len(gone) == len(new) == 1:
            self.moved[draft_id(row.frame_id, gone[0])] = draft_id(row.frame_id, new[0])

    def _remember(self, row: AnyRow) -> None:
        uid = _uid(row)
        if row.kind == "label_created" and row.told is not None and row.told.startswith(DRAFT):
            self.became[row.told] = uid
        if uid not in self.proposed and row.before is not None and PROPOSED_JSON in row.before:
            self.proposed[uid] = LabelState.model_validate_json(row.before)


def _uid(row: AnyRow) -> str:
    uid: str = row.subject.partition(":")[2]
    return uid
